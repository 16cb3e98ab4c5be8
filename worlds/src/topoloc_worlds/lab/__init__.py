"""The lab: a room of 5 x 4 m."""
