"""Jobs of benchmarks/acceptance.py. Each runs commands as a user types them and yields figures."""
