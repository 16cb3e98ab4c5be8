"""Recordings made: frames of a camera that runs now, or of CARLA, written as a folder that every
command reads."""
