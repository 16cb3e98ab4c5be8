"""Results of a rig: a pose with its uncertainty, or a reason, and the result of each camera."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from topoloc.geometry.rigid import Rigid3, standard_deviations
from topoloc.json_data import OneLine
from topoloc.localization.result import Localization, NotLocalized, Reason

CameraResults = Mapping[str, Localization | NotLocalized]


@dataclass(frozen=True, eq=False, repr=False)
class RigLocalization(OneLine):
    """Hold the pose `world_from_rig` of a rig at one instant and its uncertainty.

    Attributes:
        covariance: covariance (6, 6) of xi in ``true_world_from_rig = world_from_rig @ exp(xi)``,
            order (translation, rotation), metres and radians, axes of the rig.
        probability: probability that the pose is within the tolerance of one camera's pose.
        cameras: the result of each camera that has an image, by name. Poses are those of cameras.
        used: names of the cameras whose poses are in this one.
        left_out: what is wrong with cameras that contradict the others, by name.
        tile: name of the map in whose world the pose is, None if no atlas was queried.
    """

    world_from_rig: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    probability: float
    cameras: CameraResults
    used: tuple[str, ...]
    left_out: Mapping[str, str] = field(default_factory=dict)
    tile: str | None = None

    @property
    def localized(self) -> Literal[True]:
        """Return True."""
        return True

    @property
    def position_sigma_m(self) -> float:
        """Return the root mean square position error (metres) by `covariance`."""
        return standard_deviations(self.covariance)[0]

    @property
    def rotation_sigma_deg(self) -> float:
        """Return the root mean square rotation error (degrees) by `covariance`."""
        return math.degrees(standard_deviations(self.covariance)[1])

    def to_json(self, query: str = "") -> dict[str, Any]:
        """Return one line of the result file, see docs/cli.md."""
        return {
            "query": query,
            "localized": True,
            "world_from_rig": self.world_from_rig.to_json(),
            "covariance": self.covariance.tolist(),
            "position_sigma_m": self.position_sigma_m,
            "rotation_sigma_deg": self.rotation_sigma_deg,
            "probability": self.probability,
            "used": list(self.used),
            **({} if self.tile is None else {"tile": self.tile}),
            **_cameras_json(self),
        }


@dataclass(frozen=True, eq=False, repr=False)
class RigNotLocalized(OneLine):
    """Report that no pose of the rig is certain enough, with the `reason`. `cameras` and `left_out`
    are as in `RigLocalization`."""

    reason: Reason
    detail: str
    cameras: CameraResults
    left_out: Mapping[str, str] = field(default_factory=dict)

    @property
    def localized(self) -> Literal[False]:
        """Return False."""
        return False

    def to_json(self, query: str = "") -> dict[str, Any]:
        """Return one line of the result file, see docs/cli.md."""
        refusal = {"query": query, "localized": False, "reason": self.reason, "detail": self.detail}
        return refusal | _cameras_json(self)


def as_image(result: RigLocalization | RigNotLocalized) -> Localization | NotLocalized:
    """Return the result as that of one image at the frame of the rig. Node, counts and origin are
    those of the camera with the most inliers, times are the sums of all."""
    parts = list(result.cameras.values())
    times = Counter[str]()
    for one in parts:
        times.update(one.times_ms)
    if isinstance(result, RigNotLocalized):
        return NotLocalized(result.reason, times_ms=dict(times), detail=result.detail)
    best = max((result.cameras[name] for name in result.used), key=lambda one: one.num_inliers)
    node_id = best.node_id if isinstance(best, Localization) else best.alternatives[0].node_id
    return Localization(
        result.world_from_rig,
        result.world_from_rig.transform_covariance(result.covariance),
        result.probability,
        node_id,
        best.candidates,
        best.num_matches,
        best.num_inliers,
        dict(times),
        provenance=best.provenance,
    )


def _cameras_json(result: RigLocalization | RigNotLocalized) -> dict[str, Any]:
    cameras = {name: one.to_json(name) for name, one in result.cameras.items()}
    return {"left_out": dict(result.left_out), "cameras": cameras}
