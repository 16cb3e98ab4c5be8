"""The hospital: a loop of equal wall panels, with a door now and then."""
