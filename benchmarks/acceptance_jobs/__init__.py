"""The jobs of benchmarks/acceptance.py: each runs commands as a user types them and yields figures."""
