"""The table that `evaluate` and `demo` print: one row a recording."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

_COLUMNS = ("recording", "localized", "median error", "in 5 cm, 5 deg", "in 25 cm, 2 deg", "false accepts", "ms")


def print_recordings(evaluation: dict[str, Any], published: Sequence[tuple[str, float, float]] = ()) -> None:
    """Print the rows of an evaluation (`summarize`), then what others published: (name, metres, degrees)."""
    rows = [_COLUMNS, *(_row(recording) for recording in evaluation["recordings"])]
    rows += [(name, "", _error(metres, degrees), "", "", "", "") for name, metres, degrees in published]
    widths = [max(len(row[column]) for row in rows) for column in range(len(_COLUMNS))]
    for name, *cells in rows:
        padded = [f"{cell:>{width}}" for cell, width in zip(cells, widths[1:], strict=True)]
        print("  ".join([f"{name:<{widths[0]}}", *padded]).rstrip())


def _row(recording: dict[str, Any]) -> tuple[str, ...]:
    recall, num = recording["recall"], recording["num_queries"]
    shares = [f"{100 * recall[key]:.0f} %" if num else "" for key in ("0.05m_5deg", "0.25m_2deg")]
    median = _error(recording["median_translation_m"], recording["median_rotation_deg"]) if recording["num_localized"] else ""
    total = recording["median_times_ms"].get("total")
    return (
        recording["name"],
        f"{recording['num_localized']} of {num}" if num else "",
        median,
        *shares,
        f"{recording['false_accepts']} of {num + recording['num_elsewhere']}",
        "" if total is None else f"{total:.0f}",
    )


def _error(metres: float, degrees: float) -> str:
    return f"{100 * metres:.2f} cm, {degrees:.2f} deg"
