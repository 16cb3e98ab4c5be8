"""Convert results to JSON and back, so that tables and figures need no new queries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from topoloc.evaluation.metrics import EvaluatedQuery
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.provenance import Evidence
from topoloc.localization.result import Localization, NotLocalized, result_from_json
from topoloc.recordings.frame import StereoSequence


def rows_of(answers: Sequence[EvaluatedQuery]) -> list[dict[str, Any]]:
    """A row of plain JSON for each answer."""
    return [_row_of(answer) for answer in answers]


def answers_of(
    rows: Sequence[dict[str, Any]], recording: str, sequence: StereoSequence | None = None
) -> list[EvaluatedQuery]:
    """Return the inverse of `rows_of`. Images and cameras are read lazily from `sequence`."""
    cameras = _Pictures(sequence) if sequence is not None else None
    return [_answer_of(row, recording, cameras) for row in rows]


def pose_to_json(world_from_cam: Rigid3) -> list[float]:
    """Translation (metres), then the quaternion, w first."""
    return [*world_from_cam.translation.tolist(), *world_from_cam.quat_wxyz().tolist()]


def pose_of(numbers: Sequence[float]) -> Rigid3:
    """The inverse of `pose_to_json`."""
    return Rigid3.from_quat_wxyz(np.array(numbers[3:]), np.array(numbers[:3]))


def _row_of(answer: EvaluatedQuery) -> dict[str, Any]:
    row = answer.result.to_json(answer.query)
    if isinstance(answer.result, Localization) and answer.result.evidence is not None:
        row["evidence"] = {
            name: np.asarray(value).item() for name, value in asdict(answer.result.evidence).items()
        }
    if answer.world_from_cam is not None:
        row["truth"] = pose_to_json(answer.world_from_cam)
    return row | {"nearest": answer.nearest_node_id, "neighbours": sorted(answer.neighbour_ids)}


def _answer_of(row: dict[str, Any], recording: str, pictures: _Pictures | None) -> EvaluatedQuery:
    truth = pose_of(row["truth"]) if "truth" in row else None
    read_image = None if pictures is None else pictures.reader(row["query"])
    camera = None if pictures is None else pictures.camera
    return EvaluatedQuery(
        row["query"],
        _result_of(row),
        truth,
        row["nearest"],
        recording,
        read_image,
        camera,
        frozenset(row["neighbours"]),
    )


def _result_of(row: dict[str, Any]) -> Localization | NotLocalized:
    result = result_from_json(row)
    if isinstance(result, Localization) and "evidence" in row:
        return replace(result, evidence=Evidence(**row["evidence"]))
    return result


class _Pictures:
    """A recording's pictures by their names, and its camera: that of the first frame."""

    def __init__(self, sequence: StereoSequence) -> None:
        self._sequence = sequence
        self._index = {name: i for i, name in enumerate(sequence.names)}
        self.camera = sequence[0].camera

    def reader(self, name: str) -> Any:
        return lambda: self._sequence[self._index[name]].image
