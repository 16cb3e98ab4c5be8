"""Compare two lists of answers to the same queries."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from topoloc.localization.exact.appearance import share_of_this_floor

TOLERANCE = 1e-6
EXACT = ("query", "localized", "state", "reason", "tile", "node")
POSES = (("world_from_cam", "covariance"), ("smoothed", "smoothed_covariance"))
KEPT = (*EXACT, "probability", "appearance", *(key for pair in POSES for key in pair))


@dataclass(frozen=True)
class Comparison:
    """Hold how many answers differ, and the largest differences (m, rad, 1). That of the covariance
    is relative to its diagonal."""

    compared: int
    different: int
    position: float
    angle: float
    probability: float
    first: str
    covariance: float = 0.0


def kept(answers: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the answers with only those keys that are compared, queries without their folder."""
    found = [{key: answer[key] for key in KEPT if key in answer} for answer in answers]
    for one in found:
        one["query"] = "/".join(Path(one["query"]).parts[-3:])
    return found


def without_appearance(answers: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the answers as of commits without the last step: no covariance, and the probability
    without the appearance."""
    left_out = {"appearance", "covariance", "smoothed", "smoothed_covariance", "state"}
    found = [{key: one[key] for key in one if key not in left_out} for one in answers]
    for one, answer in zip(found, answers, strict=True):
        if answer["localized"] and "appearance" in answer:
            one["probability"] /= share_of_this_floor(answer["appearance"], False)
    return found


def compare_answers(
    old: Sequence[Mapping[str, Any]], new: Sequence[Mapping[str, Any]], tolerance: float = TOLERANCE
) -> Comparison:
    """Compare reason, state, tile and node exactly; position (m), angle (rad), p and covariance by
    a tolerance. A covariance that only one side knows is not compared."""
    largest = np.zeros(4)
    wrong = [] if len(old) == len(new) else [f"{len(old)} answers, now {len(new)}"]
    for was, now in zip(old, new, strict=False):
        text = _first_difference(was, now)
        if not text:
            differences = _differences(was, now)
            if not differences.max() <= tolerance:
                moved, turned, surer, spread = differences
                text = f"{moved:.1e} m, {turned:.1e} rad, p {surer:.1e}, covariance {spread:.1e}"
            largest = np.maximum(largest, differences)
        if text:
            wrong.append(f"{was['query']}: {text}")
    first, counts = wrong[0] if wrong else "", (min(len(old), len(new)), len(wrong))
    position, angle, probability, covariance = largest.tolist()
    return Comparison(*counts, position, angle, probability, first, covariance)


def _differences(was: Mapping[str, Any], now: Mapping[str, Any]) -> np.ndarray:
    """Return metres, radians, that of the probability, and the relative one of the covariance."""
    largest = np.zeros(4)
    largest[2] = abs((was.get("probability") or 0.0) - (now.get("probability") or 0.0))
    for pose, covariance in POSES:
        if was.get(pose) and now.get(pose):
            largest[:2] = np.maximum(largest[:2], pose_difference(was[pose], now[pose]))
        if was.get(covariance) and now.get(covariance):
            a, b = np.array(was[covariance]), np.array(now[covariance])
            sigmas = np.sqrt(np.diag(a))
            largest[3] = max(largest[3], np.abs((a - b) / np.outer(sigmas, sigmas)).max())
    return largest


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
    for key in EXACT:
        if was.get(key) != now.get(key):
            return f"{key} {was.get(key)}, now {now.get(key)}"
    return ""
