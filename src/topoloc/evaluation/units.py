"""Lengths for people."""

from __future__ import annotations


def length_text(metres: float, digits: int | None = None) -> str:
    """Metres for people: in cm below one."""
    if metres >= 1.0:
        return f"{metres:.{2 if digits is None else digits}f} m"
    return f"{100 * metres:.{(2 if metres < 0.1 else 1) if digits is None else digits}f} cm"
