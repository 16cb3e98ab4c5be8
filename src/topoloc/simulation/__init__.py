"""Worlds with exact truth: rooms and streets built by code from a seed, and recordings rendered in them."""
