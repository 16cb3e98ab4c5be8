"""Check recordings for inputs that would give wrong SLAM results.

These are swapped left and right images, a baseline in millimetres, and images that are no stereo
pairs.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float32

from topoloc.errors import CalibrationError, RecordingError
from topoloc.points.disparity import MeasuredView, measure_disparities
from topoloc.points.point_tracking import align_with_reference, track_points
from topoloc.recordings.frame import StereoFrame
from topoloc.slam.keyframes import KeyFrame, Landmarks


class InputChecks:
    """Accumulate the checks of one recording."""

    def __init__(self, recording: str) -> None:
        self._recording = recording
        self._vertical_px: list[float] = []
        self._has_started = False
        self.right_residuals_px: list[Float[np.ndarray, " n"]] = []
        """Distances between measured and predicted landmarks in the right image, pixels, one array
        for each key frame."""

    def check_rig(self, frame: StereoFrame) -> None:
        """Check the baseline of the rig.

        Raises:
            CalibrationError: the baseline cannot be in metres.
        """
        max_baseline = 5.0  # metres; a larger one is assumed to be in millimetres
        if frame.rig is not None and frame.rig.baseline > max_baseline:
            raise CalibrationError(
                f"{self._recording}: a baseline of {frame.rig.baseline:g} m; is it in millimetres?"
            )

    def can_start(
        self, frame: StereoFrame, measured: MeasuredView, corners: Float32[np.ndarray, "n 2"]
    ) -> bool:
        """Return whether enough corners have a disparity to start tracking.

        Raises:
            RecordingError: they have, but only with left and right swapped.
        """
        min_start_points = 40  # minimum number of points with disparity to start tracking
        num_found = _count_disparities(measured, corners)
        right_grey = measured.view.right_grey
        if measured.right is None or right_grey is None or self._has_started:
            return num_found >= min_start_points
        # A point farther right in the right image is farther left if both images are mirrored.
        left, right = (
            np.ascontiguousarray(image[:, ::-1]) for image in (measured.left, measured.right)
        )
        mirrored = replace(measured, left=left, right=right)
        mirrored_corners = (np.array([left.shape[1] - 1, 0]) + corners * [-1, 1]).astype(np.float32)
        if _count_disparities(mirrored, mirrored_corners) > max(min_start_points, 2 * num_found):
            raise RecordingError(
                f"{self._recording}: left and right pictures are swapped: {frame.name} shows points"
                " further right in right"
            )
        if num_found < min_start_points:
            coarse, _ = track_points(measured.view.grey, right_grey, corners, corners)
            self._match_in_right_image(measured.left, measured.right, corners, coarse)
        self._has_started = num_found >= min_start_points
        return self._has_started

    def check_keyframe(
        self, keyframe: KeyFrame, landmarks: Landmarks, measured: MeasuredView
    ) -> None:
        """Match landmarks of a new key frame in the right image and compare them with their
        predictions."""
        sampled_points = 80  # points of a key frame at which the vertical distance is measured
        if measured.right is None or measured.view.rig is None:
            return
        seen = keyframe.observations
        rows = np.flatnonzero(seen.active & (seen.weights[:, 2] > 0.0))
        rows = rows[:: max(1, len(rows) // sampled_points)]
        if len(rows) == 0:
            return
        at_infinity = measured.view.rig.left.cx - measured.view.rig.right.cx
        to_right = np.column_stack([-seen.measured[rows, 2] - at_infinity, np.zeros(len(rows))])
        points = seen.measured[rows, :2]
        guesses = (points + to_right).astype(np.float32)
        found = self._match_in_right_image(
            measured.left, measured.right, points.astype(np.float32), guesses
        )
        expected = keyframe.stereo.project(
            keyframe.cam_from_world.apply(landmarks.positions[seen.landmark_ids[rows]])
        )
        expected_right = expected[:, :2] - np.column_stack(
            [expected[:, 2] + keyframe.bias.value_px + at_infinity, np.zeros(len(rows))]
        )
        self.right_residuals_px.append(np.linalg.norm(found - expected_right, axis=1))

    def check_stereo_pairs(self) -> None:
        """Check that left and right images are stereo pairs.

        Raises:
            RecordingError: they were taken at different times, or are not rectified as calibrated.
        """
        min_keyframes = 3  # minimum number of key frames for this check
        # Maximum vertical distance of left and right points, pixels (median over points,
        # then over key frames). Beyond it the images are no stereo pairs.
        max_vertical_px = 0.9
        if len(self._vertical_px) < min_keyframes:
            return
        vertical = float(np.median(self._vertical_px))
        if vertical > max_vertical_px:
            raise RecordingError(
                f"{self._recording}: left and right pictures are no pairs: the same points are"
                f" {vertical:.1f} px apart vertically (median); taken at different moments, or"
                " calibrated wrongly?"
            )

    def _match_in_right_image(
        self,
        left: Float32[np.ndarray, "h w"],
        right: Float32[np.ndarray, "h w"],
        points: Float32[np.ndarray, "n 2"],
        guesses: Float32[np.ndarray, "n 2"],
    ) -> Float[np.ndarray, "n 2"]:
        """Match points of the left image in the right one, also vertically, and record the vertical
        median.

        Return their pixels, NaN if not found.
        """
        scales = np.ones(len(points), np.float32)
        found = align_with_reference(left, right, points, guesses, scales, max_shift_px=5.0)
        places = np.where(found.is_matched[:, None], found.points_img, np.nan).astype(np.float64)
        if np.count_nonzero(found.is_matched) >= max(10, len(points) // 3):
            self._vertical_px.append(float(np.nanmedian(np.abs(places[:, 1] - points[:, 1]))))
        return places


def _count_disparities(measured: MeasuredView, corners: Float32[np.ndarray, "n 2"]) -> int:
    disparities, _ = measure_disparities(measured, corners, np.full(len(corners), np.nan))
    return int(np.isfinite(disparities).sum())
