"""What a query gets: a pose with its uncertainty, or an honest "not here". Never a fallback pose."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from topoloc.geometry.calibration_check import CalibrationDoubt
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.evidence import Evidence
from topoloc.places.coarse import NodeScore

Reason = Literal["too_few_matches", "too_few_inliers", "ambiguous", "not_in_map", "jump", "unreadable"]


@dataclass(frozen=True, eq=False)
class Localization:
    """The image was taken at `world_from_cam`.

    `covariance` (6, 6) is that of the left perturbation xi of world_from_cam, ``true_world_from_cam = exp(xi) @ world_from_cam``:
    order (translation, rotation), metres and radians, axes of the world. It counts the noise of the image, the uncertainty of each map
    point, and what the map's points are wrong by together (`correlated_errors.py`). Its translation part is that of the world's origin,
    as it is moved by xi; `camera_covariance` is that of the camera itself. `noise_share` of it differs from picture to picture; the rest
    is the map's, and a picture taken close by shares it.

    `probability` is that of the pose being within 0.25 m and 2 degrees, or within 5 % of the distance of what is seen where that is
    less than 0.25 m; weighed from `evidence`, with weights that were fitted to this kind of features: `calibrated` is False where none are,
    and those of another kind stand in. `node_id` is the node that most inliers come from; `times_ms` the milliseconds of each
    stage; `focal_length_px` the focal length found with the pose, None where the camera was calibrated. `calibration_doubt` is what the
    picture says against its calibration; covariance and probability have paid for it.
    """

    world_from_cam: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    probability: float
    node_id: int
    candidates: list[NodeScore]
    num_matches: int
    num_inliers: int
    times_ms: dict[str, float] = field(default_factory=dict)
    evidence: Evidence | None = None
    focal_length_px: float | None = None
    noise_share: float = 1.0
    calibrated: bool = True
    calibration_doubt: CalibrationDoubt | None = None

    @property
    def localized(self) -> Literal[True]:
        return True

    @property
    def camera_covariance(self) -> Float[np.ndarray, "6 6"]:
        """`covariance` in the camera's own axes, about its own centre: of xi in ``true_world_from_cam = world_from_cam @ exp(xi)``."""
        adjoint = self.world_from_cam.inverse().adjoint()
        return adjoint @ self.covariance @ adjoint.T

    def to_json(self, query: str) -> dict[str, Any]:
        """One line of the result file, see docs/cli.md."""
        return {
            "query": query,
            "localized": True,
            "world_from_cam": _pose_json(self.world_from_cam),
            "covariance": self.covariance.tolist(),
            "probability": self.probability,
            **({} if self.calibrated else {"calibrated": False}),
            "node": self.node_id,
            **_evidence_json(self),
            **({} if self.focal_length_px is None else {"focal_length_px": self.focal_length_px}),
            **({} if self.calibration_doubt is None else {"calibration_doubt": self.calibration_doubt.to_json()}),
        }


@dataclass(frozen=True, eq=False)
class Alternative:
    """A pose that may be the image's, and how probable that is; the rest of all is the probability of none of them."""

    world_from_cam: Rigid3
    probability: float
    node_id: int

    def to_json(self) -> dict[str, Any]:
        return {"world_from_cam": _pose_json(self.world_from_cam), "probability": self.probability, "node": self.node_id}


@dataclass(frozen=True, eq=False)
class NotLocalized:
    """No pose can be vouched for; `reason` says why.

    `alternatives` are the poses that an `ambiguous` image may have, the likeliest first.
    """

    reason: Reason
    candidates: list[NodeScore] = field(default_factory=list)
    num_matches: int = 0
    num_inliers: int = 0
    times_ms: dict[str, float] = field(default_factory=dict)
    detail: str = ""
    alternatives: tuple[Alternative, ...] = ()

    @property
    def localized(self) -> Literal[False]:
        return False

    def to_json(self, query: str) -> dict[str, Any]:
        """One line of the result file, see docs/cli.md."""
        line = {"query": query, "localized": False, "reason": self.reason, **_evidence_json(self)}
        line |= {"detail": self.detail} if self.detail else {}
        return line | ({"alternatives": [one.to_json() for one in self.alternatives]} if self.alternatives else {})


def _pose_json(world_from_cam: Rigid3) -> dict[str, list[float]]:
    return {"translation": world_from_cam.translation.tolist(), "quat_wxyz": world_from_cam.quat_wxyz().tolist()}


def _evidence_json(result: Localization | NotLocalized) -> dict[str, Any]:
    return {
        "candidates": [[c.node_id, round(c.score, 4)] for c in result.candidates],
        "num_matches": result.num_matches,
        "num_inliers": result.num_inliers,
        "times_ms": {stage: round(ms, 3) for stage, ms in result.times_ms.items()},
    }
