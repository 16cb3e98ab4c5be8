"""Match map points near their predicted pixels, given an approximate pose.

The ratio test must reject many true matches among thousands of descriptors. Within a few pixels
these matches are safe. The nodes can be selected by the camera position instead of appearance. The
nearest nodes measured their points from nearly the same place.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float, Float32, Int, Int32

from topoloc.bounds import Between
from topoloc.features.feature_types import FeatureType, GuidedThresholds
from topoloc.features.features import Features, Matches
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.guided_kernels import (
    largest_agreement,
    match_projections,
    predict_from_pixels,
    project_undistorted,
)
from topoloc.localization.pose_fit import LocalMap


@dataclass(frozen=True)
class GuidedConfig:
    """Configure guided matching. `resolved` adds the thresholds of the feature type."""

    num_nodes: Annotated[int, Between(0, 1000)] = 3
    """Number of nodes nearest to the pose proposal (Eq. 1) whose points are searched. 0 keeps the
    proposal as it is."""
    radius_px: Annotated[float, Between(0, 1000)] = 10.0
    """Search radius around the projection of a map point, in pixels of an image whose longer side
    is 640. Scales with the image size."""

    def resolved(
        self, kind: FeatureType, thresholds: GuidedThresholds | None = None
    ) -> ResolvedGuidedConfig:
        """Return the settings with the thresholds of a feature type.

        `thresholds` replaces those of the type for nearby key points. Sizes and angles are not
        compared if the feature type does not measure them.
        """
        limits = asdict(thresholds or kind.guided)
        limits |= {} if kind.has_scale else {"max_scale": math.inf}
        limits |= {} if kind.has_angle else {"max_turn": math.inf}
        return ResolvedGuidedConfig(self.num_nodes, self.radius_px, **limits)


@dataclass(frozen=True, kw_only=True)
class ResolvedGuidedConfig(GuidedConfig):
    """Hold the settings of guided matching for a feature type."""

    max_scale: float
    """Maximum ratio between the measured and the predicted key point size, in either direction."""
    max_turn: float
    """Maximum difference between the measured and the predicted orientation, radians."""
    min_similarity: float
    """Minimum scalar product of the two descriptors."""
    min_margin: float
    """Minimum difference in similarity between the best and the second key point within the
    radius."""


def match_guided(
    features: Features,
    local_map: LocalMap,
    cam_from_world: Rigid3,
    camera: Camera,
    config: GuidedConfig,
) -> Matches:
    """Match key points with map points near the pixels that `cam_from_world` predicts.

    Each key point gets at most one map point, the most similar.
    """
    return match_predicted(
        features, local_map, predict_key_points(local_map, cam_from_world, camera), camera, config
    )


def match_predicted(
    features: Features,
    local_map: LocalMap,
    predicted: Float32[np.ndarray, "n 5"],
    camera: Camera,
    config: GuidedConfig,
) -> Matches:
    """Match as `match_guided` does, with the output of `predict_key_points` given."""
    found, similarities = _match_predictions(features, local_map, predicted, camera, config)
    train_idx = np.flatnonzero(found >= 0)
    train_idx = train_idx[np.argsort(-similarities[train_idx], kind="stable")]
    query_idx, first = np.unique(found[train_idx], return_index=True)
    train_idx = train_idx[first]
    distances = np.sqrt(np.maximum(2.0 - 2.0 * similarities[train_idx], 0.0)).astype(np.float32)
    return Matches(query_idx.astype(np.int32), train_idx.astype(np.int32), distances)


def count_chance_matches(
    features: Features,
    local_map: LocalMap,
    cam_from_world: Rigid3,
    camera: Camera,
    config: GuidedConfig,
) -> int:
    """Count the matches that `match_guided` would find with a wrong pose.

    All map points are searched a third of the image away from their predictions.
    """
    predicted = predict_key_points(local_map, cam_from_world, camera)
    size = np.array([camera.width, camera.height], np.float32)
    predicted[:, :2] = np.mod(predicted[:, :2] + size / 3.0, size)
    found, _ = _match_predictions(features, local_map, predicted, camera, config)
    return len(np.unique(found[found >= 0]))


def _match_predictions(
    features: Features,
    local_map: LocalMap,
    predicted: Float32[np.ndarray, "n 5"],
    camera: Camera,
    config: GuidedConfig,
) -> tuple[Int32[np.ndarray, " n"], Float32[np.ndarray, " n"]]:
    """Return the most similar key point near each prediction (-1 for none) and its similarity."""
    assert isinstance(config, ResolvedGuidedConfig), "resolve the configuration first"
    key_points = np.column_stack(
        [features.points_img, features.sizes_px, np.cos(features.angles), np.sin(features.angles)]
    )
    return match_projections(
        predicted,
        local_map.descriptors,
        key_points.astype(np.float32),
        features.descriptors,
        float(camera.width),
        float(camera.height),
        float(config.radius_px * camera.radius_scale),
        np.float32(config.max_scale),
        np.float32(np.cos(config.max_turn) if config.max_turn < math.pi else -math.inf),
        np.float32(config.min_similarity),
        np.float32(config.min_margin),
    )


def select_visible_points(
    local_map: LocalMap, cam_from_world: Rigid3, camera: Camera
) -> tuple[Int[np.ndarray, " v"], Float[np.ndarray, "v 2"]]:
    """Return the rows of the map points in the camera's view, and their pixels."""
    _, pixels = _project_points(local_map, cam_from_world, camera)
    rows = np.flatnonzero(np.isfinite(pixels[:, 0]))
    return rows, pixels[rows]


def _project_points(
    local_map: LocalMap, cam_from_world: Rigid3, camera: Camera
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 2"]]:
    """Return the map points in the camera frame (metres) and their pixels, NaN if out of view."""
    if not camera.is_distorted:
        fx, fy, cx, cy = camera.intrinsics
        return project_undistorted(
            local_map.points_world,
            np.ascontiguousarray(cam_from_world.rotation),
            np.ascontiguousarray(cam_from_world.translation),
            (fx, fy),
            (cx, cy),
            camera.width,
            camera.height,
        )
    points_cam = cam_from_world.apply(local_map.points_world)
    pixels = camera.img_from_cam(points_cam)
    return points_cam, np.where(camera.is_in_image(pixels)[:, None], pixels, np.nan)


def predict_key_points(
    local_map: LocalMap, cam_from_world: Rigid3, camera: Camera
) -> Float32[np.ndarray, "n 5"]:
    """Predict the pixel, size and orientation (cosine, sine) of each map point, NaN if out of view.

    The surface is assumed to face the node's camera. `max_scale` and `max_turn` allow for its
    slant.
    """
    points_cam, pixels = _project_points(local_map, cam_from_world, camera)
    rotation = np.ascontiguousarray(cam_from_world.rotation)
    return predict_from_pixels(
        points_cam, pixels, local_map.sizes, local_map.directions, rotation, float(camera.fx)
    )


def count_consistent_displacements(
    features: Features,
    matches: Matches,
    predicted: Float32[np.ndarray, "n 5"],
    camera: Camera,
    within_px: float,
) -> int:
    """Count the matches with consistent displacements from their predictions.

    The count is the largest number of matches within `within_px` of the displacement of one match.
    `within_px` refers to an image whose longer side is 640 pixels, and scales with the image size.
    """
    shifts = features.points_img[matches.query_idx] - predicted[matches.train_idx, :2]
    return int(largest_agreement(shifts, np.float32(within_px * camera.radius_scale)))
