"""Commands that turn recordings into trajectories and maps, or make recordings."""
