"""Guided matching: once a pose is roughly known, map points are sought where they must be seen.

Matches that the ratio test had to give up among thousands of descriptors are safe within a few pixels, and the nodes can
be chosen by where the camera stands instead of by looks: the nearest ones, whose points were measured from nearly the
same place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from topoloc.features.features import Features, Matches
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.guided_kernels import match_projections
from topoloc.localization.local_map import LocalMap


@dataclass(frozen=True)
class GuidedConfig:
    """Settings of guided matching."""

    num_nodes: int = 4
    """Nodes nearest to the first pose (Eq. 1) whose points are sought; 0 keeps the first pose as it is."""
    radius_px: float = 10.0
    """How far from its projection a map point is sought, in an image of 640 pixels' width; grows with the width."""
    min_similarity: float = 0.75
    """Least scalar product of the two descriptors."""
    min_margin: float = 0.03
    """By how much the best key point must lead the next one within the radius."""


def match_guided(features: Features, local_map: LocalMap, cam_from_world: Rigid3, camera: Camera, config: GuidedConfig) -> Matches:
    """Matches of key points with map points that `cam_from_world` lets expect nearby: one map point a key point, the most similar."""
    projections = camera.img_from_cam(cam_from_world.apply(local_map.points_world))
    radius = config.radius_px * max(camera.width / 640.0, 0.5)
    found, similarities = match_projections(
        projections,
        local_map.descriptors,
        features.points_img,
        features.descriptors,
        float(camera.width),
        float(camera.height),
        float(radius),
        np.float32(config.min_similarity),
        np.float32(config.min_margin),
    )
    train_idx = np.flatnonzero(found >= 0)
    train_idx = train_idx[np.argsort(-similarities[train_idx], kind="stable")]
    query_idx, first = np.unique(found[train_idx], return_index=True)
    train_idx = train_idx[first]
    distances = np.sqrt(np.maximum(2.0 - 2.0 * similarities[train_idx], 0.0)).astype(np.float32)
    return Matches(query_idx.astype(np.int32), train_idx.astype(np.int32), distances)
