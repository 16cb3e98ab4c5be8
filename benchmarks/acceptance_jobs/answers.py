"""Compare two lists of answers to the same queries."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from topoloc.localization.exact.appearance import share_of_this_floor

TOLERANCE = 1e-6
KEPT = ("query", "localized", "reason", "tile", "node", "probability", "world_from_cam")


@dataclass(frozen=True)
class Comparison:
    """Hold how many answers differ, and the largest differences (m, rad, 1)."""

    compared: int
    different: int
    position: float
    angle: float
    probability: float
    first: str


def kept(answers: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the answers with only those keys that are compared. The probability is that without
    the appearance, which old commits did not know."""
    found = [{key: answer[key] for key in KEPT if key in answer} for answer in answers]
    for one, answer in zip(found, answers, strict=True):
        if answer["localized"] and "appearance" in answer:
            one["probability"] /= share_of_this_floor(answer["appearance"], False)
    return found


def compare_answers(
    old: Sequence[Mapping[str, Any]], new: Sequence[Mapping[str, Any]], tolerance: float = TOLERANCE
) -> Comparison:
    """Compare reason, tile and node exactly; position (m), angle (rad) and p by a tolerance."""
    position = angle = probability = 0.0
    wrong = [] if len(old) == len(new) else [f"{len(old)} answers, now {len(new)}"]
    for was, now in zip(old, new, strict=False):
        text = _first_difference(was, now)
        if not text and was["localized"]:
            moved, turned = pose_difference(was["world_from_cam"], now["world_from_cam"])
            surer = abs(was["probability"] - now["probability"])
            if not max(moved, turned, surer) <= tolerance:
                text = f"{moved:.1e} m, {turned:.1e} rad, p {surer:.1e}"
            position, angle = max(position, moved), max(angle, turned)
            probability = max(probability, surer)
        if text:
            wrong.append(f"{was['query']}: {text}")
    first = wrong[0] if wrong else ""
    return Comparison(min(len(old), len(new)), len(wrong), position, angle, probability, first)


def pose_difference(first: Mapping[str, Any], second: Mapping[str, Any]) -> tuple[float, float]:
    """Return metres and radians between two poses, as results write them."""
    moved = math.dist(first["translation"], second["translation"])
    a, b = first["quat_wxyz"], second["quat_wxyz"]
    # The vector part of the relative rotation is exact for small angles, unlike the arc cosine.
    w = abs(sum(x * y for x, y in zip(a, b, strict=True)))
    vector = (
        a[0] * b[1] - a[1] * b[0] - a[2] * b[3] + a[3] * b[2],
        a[0] * b[2] + a[1] * b[3] - a[2] * b[0] - a[3] * b[1],
        a[0] * b[3] - a[1] * b[2] + a[2] * b[1] - a[3] * b[0],
    )
    return moved, 2 * math.atan2(math.hypot(*vector), w)


def _first_difference(was: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    for key in ("query", "localized", "reason", "tile", "node"):
        if was.get(key) != now.get(key):
            return f"{key} {was.get(key)}, now {now.get(key)}"
    return ""
