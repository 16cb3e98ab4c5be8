"""Verify that two key frames see the same place, and estimate their relative pose.

Local features are matched, and robust PnP on metric points gives the pose.
"""

from __future__ import annotations

from collections import deque
from concurrent.futures import Executor, Future
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from topoloc.features.config import MatchingConfig
from topoloc.features.extraction import extract_features
from topoloc.features.feature_types import FeatureConfig, find_feature_type
from topoloc.features.matching import match_features
from topoloc.geometry.absolute_pose import AbsolutePose, AbsolutePoseConfig, estimate_absolute_pose
from topoloc.geometry.rigid import Rigid3
from topoloc.points.metric_points import MetricPoints, StereoCamera, locate_points
from topoloc.recordings.frame_preparation import PreparedFrame
from topoloc.slam.keyframes import PlaceFeatures
from topoloc.slam.motion_prediction import Prediction
from topoloc.slam.step_estimation import Step

_MIN_SEPARATION = 0.05  # of the image width, to exclude the same feature at another scale


@dataclass(frozen=True, eq=False)
class PlaceMatch:
    """Hold target_from_source, the covariance of its left perturbation, and the rows of the
    inliers."""

    target_from_source: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    source_rows: Int[np.ndarray, " n"]
    target_rows: Int[np.ndarray, " n"]


def extract_place_features(view: PreparedFrame) -> PlaceFeatures:
    """Extract the local features of a view with their metric points."""
    features = extract_features(view.grey, FeatureConfig(max_features=500))
    return PlaceFeatures(features, locate_points(features, view))


def match_places(
    source: PlaceFeatures,
    target: PlaceFeatures,
    stereo: StereoCamera,
    min_inliers: int = 25,
    min_inlier_share: float = 0.35,
) -> PlaceMatch | None:
    """Estimate target_from_source of two views. None if too few matches agree.

    Args:
        stereo: the camera of the target.
        min_inliers: minimum number of matches that agree on the relative pose.
        min_inlier_share: minimum share of the matches that agree on the relative pose.
    """
    max_sigma = 0.5  # maximum sigma of the relative position, metres
    rows = np.flatnonzero(source.points.valid)
    matching = MatchingConfig(ratio=find_feature_type("surf").ratio)
    matches = match_features(
        target.features.descriptors, source.features.descriptors[rows], matching
    )
    if len(matches) < min_inliers:
        return None
    source_rows, target_rows = rows[matches.train_idx], matches.query_idx.astype(np.int64)
    points_img = target.features.points_img[target_rows].astype(np.float64)
    pose = _estimate_pose(points_img, source.points, source_rows, stereo, -matches.distances)
    if pose is None:
        return None
    num_inliers = int(np.count_nonzero(pose.inliers))
    if num_inliers < min_inliers or num_inliers < min_inlier_share * len(matches):
        return None
    if np.sqrt(np.trace(pose.covariance[:3, :3])) > max_sigma:
        return None
    return PlaceMatch(
        pose.cam_from_world, pose.covariance, source_rows[pose.inliers], target_rows[pose.inliers]
    )


def find_repetition(
    view: PlaceFeatures, stereo: StereoCamera, min_inliers: int = 30
) -> tuple[int, Rigid3]:
    """Find the motion of the camera after which a view looks the same.

    Return how many features match others of the image by it, and the motion. The number is high for
    repetitive structures such as a wall of equal panels. Each feature is matched with the most
    similar distant one, mutually. The number is that of PnP inliers, 0 if there are fewer than
    `min_inliers`. Of 500, panels have 42 or more, other scenes at most 18.
    """
    none = 0, Rigid3.identity()
    points_img, descriptors = view.features.points_img.astype(np.float64), view.features.descriptors
    if len(descriptors) < min_inliers:
        return none
    squares, min_apart = np.sum(points_img**2, axis=1), _MIN_SEPARATION * stereo.camera.width
    squared_apart = squares[:, None] + squares - 2.0 * points_img @ points_img.T
    likeness = np.where(squared_apart < min_apart**2, -np.inf, descriptors @ descriptors.T)
    rows, nearest = np.arange(len(descriptors)), np.argmax(likeness, axis=1)
    mutual = (
        (np.argmax(likeness, axis=0)[nearest] == rows)
        & view.points.valid[nearest]
        & np.isfinite(likeness[rows, nearest])
    )
    if np.count_nonzero(mutual) < min_inliers:
        return none
    sources, priorities = nearest[mutual], likeness[rows, nearest][mutual]
    pose = _estimate_pose(points_img[mutual], view.points, sources, stereo, priorities)
    if pose is None or np.count_nonzero(pose.inliers) < min_inliers:
        return none
    return int(np.count_nonzero(pose.inliers)), pose.cam_from_world


class RepetitionCheck:
    """Hold how the last places repeat themselves. They are searched in the background, so of a
    moving camera the last place but one is used."""

    def __init__(self) -> None:
        none = Future[tuple[int, Rigid3]]()
        none.set_result((0, Rigid3.identity()))
        self._last = deque([none, none], maxlen=12)

    def add(self, executor: Executor, place: Future[PlaceFeatures], stereo: StereoCamera) -> None:
        """Add a place, whose features `executor` extracts."""
        self._last.append(executor.submit(lambda: find_repetition(place.result(), stereo)))

    def is_likely(self, prediction: Prediction, step: Step) -> bool:
        """Return whether the places before a step are repetitive. If the motion is unknown, the
        last one counts, too, and so does a step on which few of the visible points agree."""
        num_repeated = self._last[-2].result()[0]
        if num_repeated or np.isfinite(prediction.sigma):
            return num_repeated > 0
        return self._last[-1].result()[0] > 0 or bool(step.inlier_ratio < 0.8)

    def find_motions(self) -> list[Rigid3]:
        """Return the motions of the camera after which one of the last places looks the same."""
        found = [future.result() for future in self._last]
        return [motion for num, motion in found if num]


def _estimate_pose(
    points_img: Float[np.ndarray, "n 2"],
    points: MetricPoints,
    rows: Int[np.ndarray, " n"],
    stereo: StereoCamera,
    priorities: np.ndarray,
) -> AbsolutePose | None:
    return estimate_absolute_pose(
        points_img,
        points.points_cam[rows],
        stereo.camera,
        AbsolutePoseConfig(max_reprojection_error_px=2.5, sigma_px=0.8, max_iterations=1000),
        point_covariances=points.covariances[rows],
        priorities=priorities.astype(np.float64),
    )
