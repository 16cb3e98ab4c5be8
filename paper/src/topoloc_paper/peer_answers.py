"""Define the results of peers: for each query a pose or none, and the time that it took.

They are evaluated as our own results are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from topoloc.evaluation.metrics import MAX_ROTATION_DEG, MAX_TRANSLATION
from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import StereoFrame
from topoloc_paper.stored_answers import pose_of, pose_to_json


@dataclass(frozen=True, eq=False)
class PeerAnswer:
    """Hold a pose, None if the peer found none, and the milliseconds that it took."""

    world_from_cam: Rigid3 | None
    ms: float


@runtime_checkable
class Peer(Protocol):
    """A localizer of another make, with its map ready."""

    map_bytes: int

    def localize(self, frames: Sequence[StereoFrame]) -> list[PeerAnswer]:
        """Return a result for each frame, from its image and camera alone."""
        ...


def rows_of(
    frames: Sequence[StereoFrame], answers: Sequence[PeerAnswer], map_from_truth: Rigid3
) -> list[dict[str, Any]]:
    """Rows as JSON; frames without a pose are from elsewhere."""
    rows = []
    for frame, answer in zip(frames, answers, strict=True):
        truth = (
            None
            if frame.world_from_cam is None
            else pose_to_json(map_from_truth @ frame.world_from_cam)
        )
        pose = None if answer.world_from_cam is None else pose_to_json(answer.world_from_cam)
        rows.append({"query": frame.name, "pose": pose, "truth": truth, "ms": answer.ms})
    return rows


def summarize_peer(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Summarize as `metrics.summarize` does: medians over localized queries. `far_off` and
    `accepted` (out-of-map images) count false accepts."""
    asked = [row for row in rows if row["truth"] is not None]
    localized = [
        (pose_of(row["pose"]), pose_of(row["truth"])) for row in asked if row["pose"] is not None
    ]
    metres = np.array([translation_error(found, truth) for found, truth in localized])
    degrees = np.array(
        [float(np.rad2deg(rotation_error(found, truth))) for found, truth in localized]
    )
    elsewhere = [row for row in rows if row["truth"] is None]
    return {
        "num_queries": len(asked),
        "num_localized": len(localized),
        "median_translation_m": float(np.median(metres)) if len(metres) else None,
        "median_rotation_deg": float(np.median(degrees)) if len(degrees) else None,
        "recall_25cm": float(np.sum((metres <= 0.25) & (degrees <= 2.0)) / max(len(asked), 1)),
        "far_off": int(np.sum((metres > MAX_TRANSLATION) | (degrees > MAX_ROTATION_DEG))),
        "num_elsewhere": len(elsewhere),
        "accepted": sum(row["pose"] is not None for row in elsewhere),
        "ms": float(np.median([row["ms"] for row in asked])) if asked else None,
    }
