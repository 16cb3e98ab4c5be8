"""Do two key frames see the same place, and from where? Local features matched, then robust PnP on
metric points."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int

from topoloc.bounds import Above, AtLeast, Between
from topoloc.features.extraction import extract_features
from topoloc.features.feature_types import FeatureConfig, find_feature_type
from topoloc.features.matching import MatchingConfig, match_features
from topoloc.geometry.absolute_pose import AbsolutePoseConfig, estimate_absolute_pose
from topoloc.geometry.rigid import Rigid3
from topoloc.points.disparity import StereoCamera
from topoloc.points.metric_points import MetricPointsConfig, locate_points
from topoloc.recordings.frame_preparation import PreparedFrame
from topoloc.slam.keyframes import PlaceFeatures

_MIN_SEPARATION = 0.05  # of the picture's width, so that a feature is not itself at another scale


@dataclass(frozen=True)
class PlaceMatchingConfig:
    """What makes two views the same place."""

    features: FeatureConfig = field(default_factory=lambda: FeatureConfig(max_features=500))
    points: MetricPointsConfig = field(default_factory=MetricPointsConfig)
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    pose: AbsolutePoseConfig = field(
        default_factory=lambda: AbsolutePoseConfig(
            max_reprojection_error_px=2.5, sigma_px=0.8, max_iterations=1000
        )
    )
    min_inliers: Annotated[int, AtLeast(4)] = 25
    """Matches that agree on the relative pose, at least."""
    min_inlier_share: Annotated[float, Between(0, 1)] = 0.35
    """Share of the matches that agree on it, at least."""
    max_sigma: Annotated[float, Above(0)] = 0.5
    """A relative position that is less certain than this (metres, one sigma) says nothing."""


@dataclass(frozen=True, eq=False)
class PlaceMatch:
    """target_from_source with the covariance of its left perturbation, and the rows of the features
    that agree."""

    target_from_source: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    source_rows: Int[np.ndarray, " n"]
    target_rows: Int[np.ndarray, " n"]


def extract_place_features(view: PreparedFrame, config: PlaceMatchingConfig) -> PlaceFeatures:
    """The local features of a view, and where they are."""
    features = extract_features(view.grey, config.features)
    return PlaceFeatures(features, locate_points(features, view, config.points))


def match_places(
    source: PlaceFeatures, target: PlaceFeatures, stereo: StereoCamera, config: PlaceMatchingConfig
) -> PlaceMatch | None:
    """Where `source` was taken, seen from `target` (whose camera is `stereo`), or None where they
    do not agree on it."""
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
    """How many of a view's features look like others of the same picture, all as from one other
    place: a wall of equal panels.

    Each is matched with the one most like it elsewhere in the picture, and the other way round; so
    many agree on a pose.
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
