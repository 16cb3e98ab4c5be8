"""Two maps of overlapping pieces of one recording: the same pictures became part of both, and say
how these lie to each other.

No two pictures that a camera takes are the same to the last bit, for their noise differs. So maps
that were taught by the same ones saw the same place, whatever else looks like it.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from topoloc.geometry.rigid import Rigid3
from topoloc.geometry.transform_consensus import (
    ConsensusConfig,
    DriftConfig,
    TransformConsensus,
    diagonal_covariance,
    find_consensus,
    propagate_estimate,
)
from topoloc.mapping.topomap import TopoMetricMap

_MAX_IMAGES = 200
_SIGMA_M, _SIGMA_DEG = 0.01, 0.1  # of the way from one map to the other as one picture has it


def estimate_by_shared_images(
    first: TopoMetricMap, second: TopoMetricMap, along: DriftConfig, config: ConsensusConfig
) -> tuple[Rigid3, np.ndarray, int] | None:
    """first_from_second (metres), the covariance of its left perturbation (m, rad), and how many
    pictures of both maps agree on it; None where they have too few in common, or these say
    different things."""
    here, there = _image_poses(first), _image_poses(second)
    shared = sorted(here.keys() & there.keys(), key=lambda picture: (picture[0], picture[1]))
    chosen = (
        np.unique(
            np.linspace(0, len(shared) - 1, min(len(shared), _MAX_IMAGES)).round().astype(int)
        )
        if shared
        else []
    )
    poses = [(here[shared[k]], there[shared[k]]) for k in chosen]
    if len(poses) < config.min_independent:
        return None
    one, other = poses[len(poses) // 2]
    said = [
        propagate_estimate(
            one.inverse() @ a,
            Rigid3.identity(),
            diagonal_covariance(_SIGMA_M, _SIGMA_DEG),
            b.inverse() @ other,
            along,
        )
        for a, b in poses
    ]
    consensus = find_consensus(
        [pose for pose, _ in said], np.stack([covariance for _, covariance in said]), config
    )
    return None if consensus is None else _to_worlds(consensus, one, other)


def _to_worlds(
    consensus: TransformConsensus, one: Rigid3, other: Rigid3
) -> tuple[Rigid3, np.ndarray, int]:
    adjoint = one.adjoint()
    covariance = adjoint @ consensus.covariance @ adjoint.T
    return (
        one @ consensus.a_from_b @ other.inverse(),
        0.5 * (covariance + covariance.T),
        int(np.count_nonzero(consensus.is_inlier)),
    )


def _image_poses(topomap: TopoMetricMap) -> dict[tuple[str, bytes], Rigid3]:
    """world_from_cam of each mapping picture, by its name and bytes; without those that are there
    several times, as of a covered lens."""
    pictures = [(image.name, image.jpeg, image.world_from_cam) for image in topomap.place_images]
    times = Counter(jpeg for _, jpeg, _ in pictures)
    return {(name, jpeg): pose for name, jpeg, pose in pictures if times[jpeg] == 1}
