"""Verify that two key frames see the same place, and estimate their relative pose.

Local features are matched, and robust PnP on metric points gives the pose.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int

from topoloc.bounds import Above, AtLeast, Between
from topoloc.features.config import MatchingConfig
from topoloc.features.extraction import extract_features
from topoloc.features.feature_types import FeatureConfig, find_feature_type
from topoloc.features.matching import match_features
from topoloc.geometry.absolute_pose import AbsolutePoseConfig, estimate_absolute_pose
from topoloc.geometry.rigid import Rigid3
from topoloc.points.config import MetricPointsConfig
from topoloc.points.disparity import StereoCamera
from topoloc.points.metric_points import locate_points
from topoloc.recordings.frame_preparation import PreparedFrame
from topoloc.slam.keyframes import PlaceFeatures

_MIN_SEPARATION = 0.05  # of the image width, to exclude the same feature at another scale


@dataclass(frozen=True)
class PlaceMatchingConfig:
    """Configure the verification of a place."""

    features: FeatureConfig = field(default_factory=lambda: FeatureConfig(max_features=500))
    points: MetricPointsConfig = field(default_factory=MetricPointsConfig)
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    pose: AbsolutePoseConfig = field(
        default_factory=lambda: AbsolutePoseConfig(
            max_reprojection_error_px=2.5, sigma_px=0.8, max_iterations=1000
        )
    )
    min_inliers: Annotated[int, AtLeast(4)] = 25
    """Minimum number of matches that agree on the relative pose."""
    min_inlier_share: Annotated[float, Between(0, 1)] = 0.35
    """Minimum share of the matches that agree on the relative pose."""
    max_sigma: Annotated[float, Above(0)] = 0.5
    """Maximum sigma of the relative position, metres."""


@dataclass(frozen=True, eq=False)
class PlaceMatch:
    """Hold target_from_source, the covariance of its left perturbation, and the rows of the
    inliers."""

    target_from_source: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    source_rows: Int[np.ndarray, " n"]
    target_rows: Int[np.ndarray, " n"]


def extract_place_features(view: PreparedFrame, config: PlaceMatchingConfig) -> PlaceFeatures:
    """Extract the local features of a view with their metric points."""
    features = extract_features(view.grey, config.features)
    return PlaceFeatures(features, locate_points(features, view, config.points))


def match_places(
    source: PlaceFeatures, target: PlaceFeatures, stereo: StereoCamera, config: PlaceMatchingConfig
) -> PlaceMatch | None:
    """Estimate target_from_source of two views. None if too few matches agree.

    `stereo` is the camera of the target.
    """
    rows, matching = (
        np.flatnonzero(source.points.valid),
        config.matching.resolved(find_feature_type(config.features.kind).ratio),
    )
    matches = match_features(
        target.features.descriptors, source.features.descriptors[rows], matching
    )
    if len(matches) < config.min_inliers:
        return None
    source_rows, target_rows = rows[matches.train_idx], matches.query_idx.astype(np.int64)
    pose = estimate_absolute_pose(
        target.features.points_img[target_rows].astype(np.float64),
        source.points.points_cam[source_rows],
        stereo.camera,
        config.pose,
        point_covariances=source.points.covariances[source_rows],
        priorities=-matches.distances.astype(np.float64),
    )
    if pose is None:
        return None
    num_inliers = int(np.count_nonzero(pose.inliers))
    if num_inliers < config.min_inliers or num_inliers < config.min_inlier_share * len(matches):
        return None
    if np.sqrt(np.trace(pose.covariance[:3, :3])) > config.max_sigma:
        return None
    return PlaceMatch(
        pose.cam_from_world, pose.covariance, source_rows[pose.inliers], target_rows[pose.inliers]
    )


def count_repeated_features(
    view: PlaceFeatures, stereo: StereoCamera, config: PlaceMatchingConfig
) -> int:
    """Count the features of a view that match others of the same image by one common relative pose.

    The count is high for repetitive structures such as a wall of equal panels. Each feature is
    matched with the most similar distant one, mutually. The result is the number of PnP inliers.
    """
    points_img, descriptors = view.features.points_img.astype(np.float64), view.features.descriptors
    apart = np.linalg.norm(points_img[:, None] - points_img, axis=2)
    likeness = np.where(
        apart < _MIN_SEPARATION * stereo.camera.width, -np.inf, descriptors @ descriptors.T
    )
    if len(descriptors) < config.min_inliers:
        return 0
    rows, nearest = np.arange(len(descriptors)), np.argmax(likeness, axis=1)
    mutual = (
        (np.argmax(likeness, axis=0)[nearest] == rows)
        & view.points.valid[nearest]
        & np.isfinite(likeness[rows, nearest])
    )
    if np.count_nonzero(mutual) < config.min_inliers:
        return 0
    sources = nearest[mutual]
    pose = estimate_absolute_pose(
        points_img[mutual],
        view.points.points_cam[sources],
        stereo.camera,
        config.pose,
        point_covariances=view.points.covariances[sources],
        priorities=likeness[rows, nearest][mutual].astype(np.float64),
    )
    return 0 if pose is None else int(np.count_nonzero(pose.inliers))
