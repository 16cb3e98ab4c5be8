"""Evaluate localization results: errors against ground truth, recall and false accepts.

Recordings of one place often have different worlds, and their pose errors are then meaningless. If
one rigid transform explains the errors, those after alignment are reported in addition. They never
replace the original errors.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar, get_args

import numpy as np
from jaxtyping import Float

from topoloc.geometry.alignment import (
    align_poses,
    normalized_pose_error,
    rotation_error,
    translation_error,
)
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.geometry.transform_consensus import find_least_median
from topoloc.json_data import OneLine, encode_json
from topoloc.localization.result import Localization, NotLocalized
from topoloc.mapping.certificate import Difficulty, Quarter
from topoloc.node_ids import NodeId
from topoloc.recordings.frame import Image
from topoloc.rigs.rig_result import RigLocalization, RigNotLocalized

# A query is recalled if its pose error is within both (metres, degrees). Recall counts all queries.
RECALL_THRESHOLDS = ((0.05, 5.0), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
# A result with an error above either limit is a false accept: a wrong place, not an inaccurate
# pose.
MAX_TRANSLATION, MAX_ROTATION_DEG = 0.5, 10.0
RIGHT_TRANSLATION, RIGHT_ROTATION_DEG = 0.25, 2.0
"""A pose further off than either (metres, degrees) is not right: the probability is about these."""
_MIN_POSES = 8  # fewer are not split into quarters


@dataclass(frozen=True, eq=False, repr=False)
class EvaluatedQuery(OneLine):
    """Hold a query with its result and its ground truth. The ground truth is None for an out-of-map
    image, for which any pose is false.

    - `read_image` reads the image again, because results hold no images.
    - `camera` is the query's camera model.
    - `neighbour_ids` are nodes as good as the nearest one, see `find_neighbour_ids`.
    - `is_in_other_world` is True if the pose is in the world of another atlas tile without a known
      transform. The pose then counts as false.
    - `angle_deg` is the angle between the true pose and the nearest node, `light_ratio` the largest
      ratio, 1 or more, of grey level, red and blue of the query and the likest node there. NaN if
      unknown.
    - `of_rig` is the result of a rig, whose pose is then that of `result`. Else None.
    """

    MAX_TRANSLATION: ClassVar[float] = MAX_TRANSLATION
    MAX_ROTATION_DEG: ClassVar[float] = MAX_ROTATION_DEG
    """A pose that is further off than either is a false accept."""

    query: str
    result: Localization | NotLocalized
    world_from_cam: Rigid3 | None
    nearest_node_id: NodeId | None = None
    recording: str = ""
    read_image: Callable[[], Image] | None = None
    camera: Camera | None = None
    neighbour_ids: frozenset[NodeId] = frozenset()
    is_in_other_world: bool = False
    angle_deg: float = math.nan
    light_ratio: float = math.nan
    of_rig: RigLocalization | RigNotLocalized | None = None

    def difficulty(self, by: Difficulty) -> float:
        """Return the value by which quarters and groups are ordered, NaN if unknown."""
        inliers = float(self.result.num_inliers)
        return {"inliers": inliers, "angle": self.angle_deg, "light": self.light_ratio}[by]

    @property
    def translation_m(self) -> float:
        """Return the distance from the ground truth in metres. NaN without a pose or ground truth
        in the same world."""
        return self._measure(translation_error)

    @property
    def rotation_deg(self) -> float:
        """Return the angle from the ground truth in degrees. NaN without a pose or ground truth in
        the same world."""
        return math.degrees(self._measure(rotation_error))

    def _measure(self, error: Callable[[Rigid3, Rigid3], float]) -> float:
        truth = None if self.is_in_other_world else self.world_from_cam
        if isinstance(self.result, NotLocalized) or truth is None:
            return math.nan
        return error(self.result.world_from_cam, truth)

    @property
    def error_over_sigma(self) -> float:
        """Return the error of the pose over its reported standard deviations: the Mahalanobis
        length over the root of its six degrees of freedom. NaN as `translation_m`."""
        truth = self.world_from_cam
        if isinstance(self.result, NotLocalized) or truth is None or self.is_in_other_world:
            return math.nan
        xi = (truth @ self.result.world_from_cam.inverse()).log()
        # the covariance of a pose that is exact in one direction is singular
        return math.sqrt(max(float(xi @ np.linalg.pinv(self.result.covariance) @ xi), 0.0) / 6.0)

    @property
    def is_inside_ellipsoid(self) -> bool:
        """Return whether the true pose is inside the 95 % ellipsoid of the result."""
        chi_square_6_at_95 = 12.592
        return 6.0 * self.error_over_sigma**2 < chi_square_6_at_95

    @property
    def is_false_accept(self) -> bool:
        """Return whether the result has a pose that is wrong: out of map, in another world, or
        beyond the error limits."""
        if isinstance(self.result, NotLocalized):
            return False
        return not self._is_within(self.MAX_TRANSLATION, self.MAX_ROTATION_DEG)

    @property
    def is_right(self) -> bool:
        """Return whether the result has a pose within 0.25 m and 2 degrees of the true one."""
        return self._is_within(RIGHT_TRANSLATION, RIGHT_ROTATION_DEG)

    def _is_within(self, metres: float, degrees: float) -> bool:
        truth = None if self.is_in_other_world else self.world_from_cam
        if isinstance(self.result, NotLocalized) or truth is None:
            return False
        return truth.is_same(self.result.world_from_cam, metres, math.radians(degrees))

    def to_json(self) -> dict[str, Any]:
        """Return the result's JSON with its recording and its ground truth, which is null for an
        out-of-map image."""
        truth = None if self.world_from_cam is None else self.world_from_cam.to_json()
        result, of = (self.result, "cam") if self.of_rig is None else (self.of_rig, "rig")
        return result.to_json(self.query) | {
            "recording": self.recording,
            f"true_world_from_{of}": truth,
        }


def group_by_recording(answers: Sequence[EvaluatedQuery]) -> dict[str, list[EvaluatedQuery]]:
    """Group the results by recording, in the order of the recordings' first queries."""
    groups: dict[str, list[EvaluatedQuery]] = {}
    for answer in answers:
        groups.setdefault(answer.recording, []).append(answer)
    return groups


def summarize(answers: list[EvaluatedQuery]) -> dict[str, Any]:
    """Return the evaluation as JSON, of all results and, under "recordings", of each recording.

    It contains counts, medians over localized queries, and recall over all queries with ground
    truth.
    """
    groups = group_by_recording(answers).items()
    return _summarize(answers) | {
        "recordings": [{"name": name} | _summarize(group) for name, group in groups]
    }


def _summarize(answers: list[EvaluatedQuery]) -> dict[str, Any]:
    with_truth = [a for a in answers if a.world_from_cam is not None]
    translation = np.array([a.translation_m for a in with_truth])
    rotation = np.array([a.rotation_deg for a in with_truth])
    localized = np.isfinite(translation)
    is_inside = np.array([a.is_inside_ellipsoid for a in with_truth], bool)
    is_inaccurate = (translation > RIGHT_TRANSLATION) | (rotation > RIGHT_ROTATION_DEG)
    ranked = [a for a in with_truth if a.nearest_node_id is not None]
    first = [(a, a.result.candidates[0].node_id if a.result.candidates else None) for a in ranked]
    hits = [node == a.nearest_node_id for a, node in first]
    near = [node == a.nearest_node_id or node in a.neighbour_ids for a, node in first]
    left_out = Counter(name for a in answers if a.of_rig for name in a.of_rig.left_out)
    reasons = [a.result.reason for a in answers if isinstance(a.result, NotLocalized)]
    return {
        "num_queries": len(with_truth),
        "num_localized": int(localized.sum()),
        "median_translation_m": _median(translation[localized]),
        "median_rotation_deg": _median(rotation[localized]),
        "max_translation_m": float(translation[localized].max()) if localized.any() else None,
        "max_rotation_deg": float(rotation[localized].max()) if localized.any() else None,
        "num_inaccurate": int(is_inaccurate.sum()),
        "num_outside_ellipsoid": int((localized & ~is_inside).sum()),
        "quarters": [encode_json(quarter) for quarter in find_quarters(answers)],
        "recall": {
            f"{metres:g}m_{degrees:g}deg": float(
                np.mean((translation <= metres) & (rotation <= degrees))
            )
            if len(with_truth)
            else None
            for metres, degrees in RECALL_THRESHOLDS
        },
        "topological_accuracy": float(np.mean(hits)) if hits else None,
        "neighbour_accuracy": float(np.mean(near)) if near else None,
        "num_elsewhere": len(answers) - len(with_truth),
        "false_accepts": sum(a.is_false_accept for a in answers),
        "not_localized": dict(sorted(Counter(reasons).items())),
        **({"left_out": dict(sorted(left_out.items()))} if left_out else {}),
        "median_times_ms": {
            stage: _median(np.array([a.result.times_ms.get(stage, 0.0) for a in answers]))
            for stage in sorted({stage for a in answers for stage in a.result.times_ms})
        },
    }


def find_quarters(answers: Sequence[EvaluatedQuery]) -> list[Quarter]:
    """Return the quarters of the poses with ground truth, the hardest first, by each difficulty: by
    inliers, by the angle to the nearest node, by the change of light. Those of a difficulty that
    fewer than eight poses have are left out."""
    posed = [a for a in answers if a.world_from_cam is not None and a.result.localized]
    found = list[Quarter]()
    for by in get_args(Difficulty):
        known = [a for a in posed if math.isfinite(a.difficulty(by))]
        known.sort(key=lambda a, by=by: a.difficulty(by), reverse=by != "inliers")
        ends = [len(known) * part // 4 for part in range(5)]
        if len(known) >= _MIN_POSES:
            found += [_measure_quarter(by, known[a:b]) for a, b in pairwise(ends)]
    return found


def _measure_quarter(by: Difficulty, posed: Sequence[EvaluatedQuery]) -> Quarter:
    results = [a.result for a in posed if isinstance(a.result, Localization)]
    return Quarter(
        by=by,
        hardest=posed[0].difficulty(by),
        easiest=posed[-1].difficulty(by),
        num_poses=len(posed),
        num_right=sum(a.is_right for a in posed),
        mean_probability=float(np.mean([one.probability for one in results])),
        num_inside=sum(a.is_inside_ellipsoid for a in posed),
        median_position_sigma_m=float(np.median([one.position_sigma_m for one in results])),
        median_rotation_sigma_deg=float(np.median([one.rotation_sigma_deg for one in results])),
    )


def _median(values: np.ndarray) -> float | None:
    return float(np.median(values)) if len(values) else None


def format_length(metres: float, digits: int | None = None) -> str:
    """Format metres for display, in cm below one metre."""
    if metres >= 1.0:
        return f"{metres:.{2 if digits is None else digits}f} m"
    return f"{100 * metres:.{(2 if metres < 0.1 else 1) if digits is None else digits}f} cm"


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
    best, median = find_least_median(
        proposals, lambda transform: _normalized_errors(transform, pairs)
    )
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
