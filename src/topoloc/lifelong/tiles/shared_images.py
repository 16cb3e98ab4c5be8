"""Estimate the transform between two maps from images that are part of both.

Maps of overlapping parts of one recording share mapping images. Because of noise, two images of a
camera are never identical. So maps with identical images show the same place, even if other places
look similar.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from topoloc.geometry.rigid import Rigid3
from topoloc.geometry.transform_consensus import (
    diagonal_covariance,
    find_consensus,
    propagate_estimate,
)
from topoloc.lifelong.node_localization import sample_evenly
from topoloc.mapping.topomap import TopoMetricMap

_SIGMA_M, _SIGMA_DEG = 0.01, 0.1  # of the transform between the maps as one image gives it


def estimate_by_shared_images(
    first: TopoMetricMap, second: TopoMetricMap
) -> tuple[Rigid3, np.ndarray, int] | None:
    """Estimate first_from_second (metres) from the images that both maps contain.

    Returns:
        first_from_second, the covariance of its left perturbation (m, rad), and the number of
        images that agree. None if the maps share too few images or the images do not agree.
    """
    max_images = 200  # evenly spaced
    here, there = _image_poses(first), _image_poses(second)
    shared = sorted(here.keys() & there.keys(), key=lambda image_key: (image_key[0], image_key[1]))
    poses = [(here[image], there[image]) for image in sample_evenly(shared, max_images)]
    if not poses:
        return None
    one, other = poses[len(poses) // 2]
    estimates = [
        propagate_estimate(
            one.inverse() @ a,
            Rigid3.identity(),
            diagonal_covariance(_SIGMA_M, _SIGMA_DEG),
            b.inverse() @ other,
            drift=0.01,
            drift_deg=0.1,
        )
        for a, b in poses
    ]
    consensus = find_consensus(
        [pose for pose, _ in estimates],
        np.stack([covariance for _, covariance in estimates]),
        rival_share=0.34,
    )
    if consensus is None:
        return None
    return *consensus.between(one, other.inverse()), int(np.count_nonzero(consensus.is_inlier))


def _image_poses(topomap: TopoMetricMap) -> dict[tuple[str, bytes], Rigid3]:
    """Return world_from_cam of each mapping image by its name and bytes. Images that occur several
    times are left out, such as images of a covered camera."""
    images = [(image.name, image.jpeg, image.world_from_cam) for image in topomap.place_images]
    times = Counter(jpeg for _, jpeg, _ in images)
    return {(name, jpeg): pose for name, jpeg, pose in images if times[jpeg] == 1}
