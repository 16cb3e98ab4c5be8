"""Detect ground truth in another world than the map: one rigid transform explains the errors.

Recordings of one place often have different worlds, and their pose errors are then meaningless. The
errors after alignment are reported in addition. They never replace the original errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from topoloc.evaluation.metrics import EvaluatedQuery
from topoloc.geometry.alignment import (
    align_poses,
    normalized_pose_error,
    rotation_error,
    translation_error,
)
from topoloc.geometry.rigid import Rigid3
from topoloc.geometry.transform_consensus import find_least_median
from topoloc.json_data import OneLine, encode_json
from topoloc.localization.result import Localization

_POSITION_SCALE_M, _ROTATION_SCALE = 0.25, np.deg2rad(2.0)


@dataclass(frozen=True, eq=False, repr=False)
class WorldFit(OneLine):
    """Hold `map_from_truth` of one recording, fitted to `num_answers` of `num_localized` results,
    and the medians of the remaining errors."""

    recording: str
    map_from_truth: Rigid3
    median_translation_m: float
    median_rotation_deg: float
    num_answers: int
    num_localized: int

    def to_json(self) -> dict[str, Any]:
        """Return the fit as JSON."""
        return encode_json(self) | {"map_from_truth": self.map_from_truth.matrix().tolist()}


def fit_worlds(answers: Sequence[EvaluatedQuery]) -> WorldFit | None:
    """Fit the transform that explains the errors of one recording's results. Return None if the
    errors are small already or no transform explains most of them.

    Each result proposes a transform. The one with the smallest median error is refined on the
    results that agree with it.
    """
    min_answers, max_share, gate = 5, 0.2, 3.0
    min_error = 1.0  # in normalized errors; smaller errors need no explanation
    pairs = [
        (a.result.world_from_cam, a.world_from_cam)
        for a in answers
        if isinstance(a.result, Localization) and a.world_from_cam
    ]
    if len(pairs) < min_answers:
        return None
    before = float(np.median(_normalized_errors(Rigid3.identity(), pairs)))
    if before < min_error:
        return None
    proposals = [found @ true.inverse() for found, true in pairs]
    best, median = find_least_median(proposals, lambda one: _normalized_errors(one, pairs))
    agreeing = [
        pair
        for pair, error in zip(pairs, _normalized_errors(best, pairs), strict=True)
        if error < max(gate * median, 1e-3)
    ]
    map_from_truth = align_poses([found for found, _ in agreeing], [true for _, true in agreeing])
    if float(np.median(_normalized_errors(map_from_truth, pairs))) > max_share * before or 2 * len(
        agreeing
    ) < len(pairs):
        return None
    translations = [translation_error(found, map_from_truth @ true) for found, true in pairs]
    rotations = [rotation_error(found, map_from_truth @ true) for found, true in pairs]
    medians = float(np.median(translations)), float(np.rad2deg(np.median(rotations)))
    return WorldFit(answers[0].recording, map_from_truth, *medians, len(agreeing), len(pairs))


def _normalized_errors(
    map_from_truth: Rigid3, pairs: Sequence[tuple[Rigid3, Rigid3]]
) -> Float[np.ndarray, " n"]:
    """Return the error of each result, 1 for 25 cm or 2 degrees."""
    scales = _POSITION_SCALE_M, _ROTATION_SCALE
    return np.array(
        [normalized_pose_error(found, map_from_truth @ true, *scales) for found, true in pairs]
    )
