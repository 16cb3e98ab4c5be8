"""Hold the tracking state that stereo and monocular odometry share."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from topoloc.geometry.rigid import Rigid3
from topoloc.points.disparity import MeasuredView
from topoloc.slam.keyframes import DisparityBias, KeyFrame, Landmarks
from topoloc.slam.motion_prediction import MotionHistory
from topoloc.slam.step_estimation import LastFrame, StepEstimator, Tracks


class FrameTracker:
    """Hold the last frame, the last key frame (reference), the points tracked since, and the key
    frames of the adjusted window."""

    def __init__(self, landmarks: Landmarks, *, min_tracked: int, patch_half_px: int) -> None:
        """Start without a frame. `StepEstimator` explains the numbers."""
        self._landmarks = landmarks
        self._min_tracked, self._patch_half_px = min_tracked, patch_half_px
        self._last_frame: LastFrame | None = None
        self._reference: KeyFrame | None = None
        self._reference_image: Float32[np.ndarray, "h w"] = np.zeros((0, 0), np.float32)
        self._tracks = Tracks.empty()
        self._recent_keyframes: list[KeyFrame] = []  # key frames since tracking last started
        self._num_lost = 0
        self._history = MotionHistory()
        self._bias = DisparityBias()

    def _step_estimator(
        self, last: LastFrame, reference: KeyFrame, tracks: Tracks, measured: MeasuredView
    ) -> StepEstimator:
        return StepEstimator(
            last,
            reference,
            self._reference_image,
            tracks,
            self._landmarks,
            measured,
            self._min_tracked,
            self._patch_half_px,
        )

    def _update_last_frame(self, t_ns: int, measured: MeasuredView, cam_from_world: Rigid3) -> None:
        last = self._last_frame
        moved = None if last is None else cam_from_world @ last.cam_from_world.inverse()
        self._history.add_pose(t_ns, cam_from_world, moved)
        self._last_frame = LastFrame(measured, cam_from_world)

    def _is_keyframe_due(self, reference: KeyFrame, measured: MeasuredView) -> bool:
        """Return whether too few points are left since the reference, or they moved too far."""
        min_share = 0.7  # of the reference's points
        max_motion = 0.03  # median, as a share of the image width
        num_active = np.count_nonzero(reference.observations.active)
        if len(self._tracks.landmark_ids) < min_share * num_active:
            return True
        return self._tracks.median_motion_px() > max_motion * measured.view.camera.width

    def _set_reference(self, keyframe: KeyFrame, measured: MeasuredView) -> None:
        """Continue tracking from a key frame, which is the last frame."""
        seen = keyframe.observations
        points = np.ascontiguousarray(seen.measured[seen.active, :2], np.float32)
        self._tracks = Tracks.from_points(seen.active_ids, points)
        self._reference, self._reference_image = keyframe, measured.left
        if self._last_frame is not None:
            self._last_frame.cam_from_world = keyframe.cam_from_world
            self._history.update_last_pose(keyframe.cam_from_world)
