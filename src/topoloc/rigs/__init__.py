"""Localize the images that several cameras of one body took at one instant."""
