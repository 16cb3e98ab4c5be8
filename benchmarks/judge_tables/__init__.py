"""The tables of `make judge`."""
