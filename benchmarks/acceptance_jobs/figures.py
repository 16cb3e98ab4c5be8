"""Define a figure and the rules by which its value may change."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# How much a value may rise, by its rule.
MAX_RISE = {"median": 0.05, "time": 0.20, "budget": 0.03}
# Sizes and distances below this are equal: two machines differ by less.
ROUNDING = 1e-6

Value = int | float | str | None


@dataclass(frozen=True)
class Figure:
    """Hold one measured value.

    The rule is `at least` or `at most` (counts, exact but for `slack`), `equal`, `median` (errors,
    bytes, memory: may rise by 5 %), `time` (a ratio to OpenCV's SIFT: may rise by 20 %), `budget`
    (may rise by 3 %) or `note` (never worse). A figure with `skipped` has no value.
    """

    name: str
    value: Value
    rule: str = "equal"
    skipped: str = ""
    slack: int = 0


@dataclass(frozen=True)
class Row:
    """Hold one line of the table."""

    job: str
    figure: str
    committed: Value
    now: Value
    verdict: str

    @property
    def is_worse(self) -> bool:
        return self.verdict.startswith(("worse", "failed", "missing", "new"))

    def text(self) -> str:
        """Return the line."""
        values = f"{_text(self.committed):>12} {_text(self.now):>12}"
        return f"{self.job:12} {self.figure:58} {values}  {self.verdict}"


def verdict(rule: str, committed: Value, now: Value, slack: int = 0) -> str:
    """Return `same`, `better` or `worse`. A count may be worse by the slack.

    Raises:
        ValueError: The rule is unknown.
    """
    if rule == "note":
        return "same" if committed == now else "other"
    if rule == "equal":
        return "same" if committed == now else "worse"
    if not isinstance(committed, int | float) or not isinstance(now, int | float):
        return "same" if committed == now else "worse"
    if rule in ("at least", "at most"):
        rise = now - committed if rule == "at most" else committed - now
        return "better" if rise < 0 else "same" if rise <= slack else "worse"
    if rule not in MAX_RISE:
        raise ValueError(f"unknown rule {rule!r}")
    share = MAX_RISE[rule]
    if now > committed * (1 + share) + ROUNDING:
        return "worse"
    return "better" if now < committed * (1 - share) - ROUNDING else "same"


def compare(job: str, figures: list[Figure], committed: Mapping[str, Any]) -> list[Row]:
    """Return a row for each figure of a job, and for each committed figure that is missing."""
    rows = []
    for figure in figures:
        known = committed.get(figure.name)
        if figure.skipped:
            value = known["value"] if known else None
            rows.append(Row(job, figure.name, value, None, f"skipped: {figure.skipped}"))
        elif known is None:
            rows.append(Row(job, figure.name, None, figure.value, "new: not committed yet"))
        else:
            now = verdict(figure.rule, known["value"], figure.value, figure.slack)
            rows.append(Row(job, figure.name, known["value"], figure.value, now))
    measured = {figure.name for figure in figures}
    for name in sorted(committed.keys() - measured):
        rows.append(Row(job, name, committed[name]["value"], None, "missing"))
    return rows


class Committed:
    """Read and write the file of committed values: mode, job, figure -> value and rule."""

    def __init__(self, path: Path, mode: str) -> None:
        self._path = path
        self._all = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        self._of_mode: dict[str, dict[str, Any]] = self._all.setdefault(mode, {})

    def setting(self, name: str, default: str) -> str:
        """Return a setting of all jobs, such as the commit that answers must be equal to."""
        return self._all.get("settings", {}).get(name, default)

    def of_job(self, job: str) -> dict[str, Any]:
        """Return the committed figures of one job."""
        return self._of_mode.get(job, {})

    def store(self, job: str, figures: list[Figure], whole: bool) -> None:
        """Replace the figures of one job. Keep skipped ones, and all others unless whole."""
        old = self.of_job(job)
        skipped = {figure.name for figure in figures if figure.skipped}
        new = {name: entry for name, entry in old.items() if name in skipped or not whole}
        for figure in figures:
            if not figure.skipped:
                new[figure.name] = {"value": figure.value, "rule": figure.rule}
        self._of_mode[job] = new

    def write(self) -> None:
        """Write the file."""
        self._path.write_text(json.dumps(self._all, indent=1, sort_keys=True) + "\n")


def rounded(number: float, digits: int = 4) -> float:
    """Return a number rounded to a number of significant digits."""
    return float(f"{number:.{digits}g}")


def errors_cm(summary: Mapping[str, Any], name: str) -> list[Figure]:
    """Return the figures of an evaluation, or of one recording of it."""
    count = f"{name}: localized of {summary['num_queries']}"
    translation, rotation = summary["median_translation_m"], summary["median_rotation_deg"]
    return [
        Figure(count, summary["num_localized"], "at least"),
        Figure(f"{name}: median error, cm", rounded(100 * translation), "median"),
        Figure(f"{name}: median error, deg", rounded(rotation), "median"),
        Figure(f"{name}: false poses", summary["false_accepts"], "at most"),
    ]


def _text(value: Value) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)[:12]
