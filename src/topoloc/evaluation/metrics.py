"""How good are these answers? Errors against truth, recall, false accepts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.result import Localization, NotLocalized, pose_to_json
from topoloc.recordings.frame import Image

# A query counts as recalled when its pose is within both (metres, degrees), of all queries.
RECALL_THRESHOLDS = ((0.05, 5.0), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
# An answer further off than both allow is a false accept: a wrong place, not a poor pose.
MAX_TRANSLATION, MAX_ROTATION_DEG = 0.5, 10.0


@dataclass(frozen=True, eq=False)
class EvaluatedQuery:
    """A query with its result and its truth, which is None for an image from elsewhere: any pose
    given for that is false.

    `read_image` reads the picture once more, for who wants to look at it: answers hold no pictures.
    `camera` is what it was taken with. `neighbour_ids` are the nodes that are as good as the
    nearest one: see `find_neighbour_ids`. `is_in_other_world`: the pose is in a world of which the
    truth says nothing, that of another tile of an atlas, and so it is false.
    """

    query: str
    result: Localization | NotLocalized
    world_from_cam: Rigid3 | None
    nearest_node_id: int | None = None
    recording: str = ""
    read_image: Callable[[], Image] | None = None
    camera: Camera | None = None
    neighbour_ids: frozenset[int] = frozenset()
    is_in_other_world: bool = False

    MAX_TRANSLATION: ClassVar[float] = MAX_TRANSLATION
    MAX_ROTATION_DEG: ClassVar[float] = MAX_ROTATION_DEG

    @property
    def translation_m(self) -> float:
        """Distance from the truth, metres; NaN where there is no pose or no truth, or truth says
        nothing of its world."""
        if (
            isinstance(self.result, NotLocalized)
            or self.world_from_cam is None
            or self.is_in_other_world
        ):
            return float("nan")
        return translation_error(self.result.world_from_cam, self.world_from_cam)

    @property
    def rotation_deg(self) -> float:
        """Angle from the truth, degrees; NaN where there is no pose or no truth, or truth says
        nothing of its world."""
        if (
            isinstance(self.result, NotLocalized)
            or self.world_from_cam is None
            or self.is_in_other_world
        ):
            return float("nan")
        return float(np.rad2deg(rotation_error(self.result.world_from_cam, self.world_from_cam)))

    @property
    def is_false_accept(self) -> bool:
        if isinstance(self.result, NotLocalized):
            return False
        if self.world_from_cam is None or self.is_in_other_world:
            return True
        return (
            self.translation_m > self.MAX_TRANSLATION or self.rotation_deg > self.MAX_ROTATION_DEG
        )

    def to_json(self) -> dict[str, Any]:
        """The result's line, with its recording and its truth, which is null for an image from
        elsewhere."""
        truth = None if self.world_from_cam is None else pose_to_json(self.world_from_cam)
        return self.result.to_json(self.query) | {
            "recording": self.recording,
            "true_world_from_cam": truth,
        }


def group_by_recording(answers: Sequence[EvaluatedQuery]) -> dict[str, list[EvaluatedQuery]]:
    """The answers of each recording, in the order in which the recordings were asked first."""
    groups: dict[str, list[EvaluatedQuery]] = {}
    for answer in answers:
        groups.setdefault(answer.recording, []).append(answer)
    return groups


def summarize(answers: list[EvaluatedQuery]) -> dict[str, Any]:
    """The evaluation as JSON, of all answers together and, under "recordings", of each recording
    alone.

    Counts, medians over what was localized, recall over all queries that have a truth.
    """
    rows = [
        {"name": name} | _summarize(group) for name, group in group_by_recording(answers).items()
    ]
    return _summarize(answers) | {"recordings": rows}


def _summarize(answers: list[EvaluatedQuery]) -> dict[str, Any]:
    with_truth = [a for a in answers if a.world_from_cam is not None]
    translation = np.array([a.translation_m for a in with_truth])
    rotation = np.array([a.rotation_deg for a in with_truth])
    localized = np.isfinite(translation)
    ranked = [a for a in with_truth if a.nearest_node_id is not None]
    first = [a.result.candidates[0].node_id if a.result.candidates else None for a in ranked]
    hits = [node == a.nearest_node_id for node, a in zip(first, ranked, strict=True)]
    near = [
        node == a.nearest_node_id or node in a.neighbour_ids
        for node, a in zip(first, ranked, strict=True)
    ]
    stages = sorted({stage for a in answers for stage in a.result.times_ms})
    return {
        "num_queries": len(with_truth),
        "num_localized": int(localized.sum()),
        "median_translation_m": _median(translation[localized]),
        "median_rotation_deg": _median(rotation[localized]),
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
        "not_localized": _count_reasons(answers),
        "median_times_ms": {
            stage: _median(np.array([a.result.times_ms.get(stage, 0.0) for a in answers]))
            for stage in stages
        },
    }


def _count_reasons(answers: list[EvaluatedQuery]) -> dict[str, int]:
    reasons = [a.result.reason for a in answers if isinstance(a.result, NotLocalized)]
    return {reason: reasons.count(reason) for reason in sorted(set(reasons))}


def _median(values: np.ndarray) -> float | None:
    return float(np.median(values)) if len(values) else None


def format_length(metres: float, digits: int | None = None) -> str:
    """Metres for people: in cm below one."""
    if metres >= 1.0:
        return f"{metres:.{2 if digits is None else digits}f} m"
    return f"{100 * metres:.{(2 if metres < 0.1 else 1) if digits is None else digits}f} cm"
