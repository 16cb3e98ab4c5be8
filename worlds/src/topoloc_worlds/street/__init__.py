"""The street: a town circuit of 333 x 81 m."""
