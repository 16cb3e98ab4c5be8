"""What is said where another process has the map that a command is to edit."""

from __future__ import annotations

import sys


def print_waiting() -> None:
    """On standard error, once: this one waits."""
    print("another process edits this map; waiting for it ...", file=sys.stderr, flush=True)
