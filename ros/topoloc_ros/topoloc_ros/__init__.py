"""Localize a robot by its camera in a map of topoloc."""
