"""Find the mountings of a rig's cameras by the poses of their images in a map.

Two cameras that a map localizes at one instant give an estimate of the pose of one in the frame of
the other. Most instants must agree.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from topoloc.geometry.rigid import Rigid3, standard_deviations
from topoloc.geometry.transform_consensus import TransformConsensus, find_consensus
from topoloc.localization.result import Localization


@dataclass(frozen=True, eq=False)
class Mounting:
    """Hold the mounting of a camera. `covariance` is that of xi in
    ``true_rig_from_cam = rig_from_cam @ exp(xi)`` (m, rad), axes of the camera. `num_agreeing` of
    `num_instants` instants agree on it."""

    rig_from_cam: Rigid3
    covariance: Float[np.ndarray, "6 6"] = field(default_factory=lambda: np.zeros((6, 6)))
    num_agreeing: int = 0
    num_instants: int = 0

    @property
    def position_sigma_m(self) -> float:
        """Return the root mean square position error by `covariance`."""
        return standard_deviations(self.covariance)[0]

    @property
    def rotation_sigma_deg(self) -> float:
        """Return the root mean square rotation error by `covariance`."""
        return math.degrees(standard_deviations(self.covariance)[1])


def find_mountings(
    instants: Sequence[Mapping[str, Localization]], reference: str, rig_from_reference: Rigid3
) -> dict[str, Mounting]:
    """Return the mountings of the cameras on which the poses of most instants agree.

    The frame of the rig is that in which the reference camera has the mounting
    `rig_from_reference`. Cameras that no image shows together with it are placed by a third one.
    """
    names = list(dict.fromkeys(name for of in instants for name in of))
    pairs = {(a, b): _compare(instants, a, b) for a in names for b in names if a != b}
    found = {reference: Mounting(rig_from_reference)}
    while True:
        coming = [
            (other, _mount(found[base], consensus, num_instants))
            for (base, other), (consensus, num_instants) in pairs.items()
            if base in found and other not in found and consensus is not None
        ]
        if not coming:
            return found
        name, best = min(coming, key=lambda pair: pair[1].position_sigma_m)
        found[name] = best


def _compare(
    instants: Sequence[Mapping[str, Localization]], a: str, b: str
) -> tuple[TransformConsensus | None, int]:
    """Return a_from_b by the instants that show both cameras in one world, and their number."""
    both = [
        (of[a], of[b])
        for of in instants
        if a in of and b in of and of[a].provenance.tile == of[b].provenance.tile
    ]
    if not both:
        return None, 0
    a_from_bs = [one.world_from_cam.inverse() @ other.world_from_cam for one, other in both]
    covariances = [
        one.camera_covariance + a_from_b.transform_covariance(other.camera_covariance)
        for a_from_b, (one, other) in zip(a_from_bs, both, strict=True)
    ]
    # images near one node share the errors of its points
    nodes = np.array([(one.node_id, other.node_id) for one, other in both])
    return find_consensus(a_from_bs, np.stack(covariances), nodes), len(both)


def _mount(base: Mounting, consensus: TransformConsensus, num_instants: int) -> Mounting:
    other_from_base = consensus.a_from_b.inverse()
    of_base = other_from_base.transform_covariance(base.covariance)
    own = other_from_base.transform_covariance(consensus.covariance)
    num_agreeing = int(np.count_nonzero(consensus.is_inlier))
    rig_from_cam = base.rig_from_cam @ consensus.a_from_b
    return Mounting(rig_from_cam, of_base + own, num_agreeing, num_instants)
