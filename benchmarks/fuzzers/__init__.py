"""Damaged inputs by kind, and one harness that reads them in child processes."""
