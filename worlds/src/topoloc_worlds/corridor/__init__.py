"""The corridor: a loop of 25 x 18 m round a courtyard."""
