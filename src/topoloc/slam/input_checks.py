"""Check recordings for inputs that would give wrong SLAM results.

These are swapped left and right images, a baseline in millimetres, and images that are no stereo
pairs.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float, Float32

from topoloc.bounds import Above, AtLeast, Between
from topoloc.errors import CalibrationError, RecordingError
from topoloc.points.disparity import DisparityConfig, MeasuredView, measure_disparities
from topoloc.points.point_tracking import TrackingConfig, align_with_reference, track_points
from topoloc.recordings.frame import StereoFrame
from topoloc.slam.keyframes import KeyFrame, Landmarks


@dataclass(frozen=True)
class InputCheckConfig:
    """Configure the conditions under which a recording is rejected."""

    max_baseline: Annotated[float, Above(0)] = 5.0
    """Maximum baseline of a stereo rig, metres. A larger one is assumed to be in millimetres."""
    min_start_points: Annotated[int, AtLeast(4)] = 40
    """Minimum number of points with disparity to start tracking."""
    max_vertical_px: Annotated[float, Above(0)] = 0.9
    """Maximum vertical distance of left and right points, pixels (median over points, then over key
    frames). Beyond it the images are no stereo pairs."""
    min_keyframes: Annotated[int, AtLeast(1)] = 3
    """Minimum number of key frames for this check."""
    tracking: TrackingConfig = field(default_factory=lambda: TrackingConfig(max_shift_px=5.0))
    sampled_points: Annotated[int, Between(1, 100_000)] = 80
    """Number of points of a key frame at which the vertical distance is measured."""


class InputChecks:
    """Accumulate the checks of one recording."""

    def __init__(self, recording: str, config: InputCheckConfig) -> None:
        self._recording, self._config = recording, config
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
        if frame.rig is not None and frame.rig.baseline > self._config.max_baseline:
            raise CalibrationError(
                f"{self._recording}: a baseline of {frame.rig.baseline:g} m; is it in millimetres?"
            )

    def can_start(
        self,
        frame: StereoFrame,
        measured: MeasuredView,
        corners: Float32[np.ndarray, "n 2"],
        config: DisparityConfig,
    ) -> bool:
        """Return whether enough corners have a disparity to start tracking.

        Raises:
            RecordingError: they have, but only with left and right swapped.
        """
        num_found = _count_disparities(measured, corners, config)
        if measured.right is None or self._has_started:
            return num_found >= self._config.min_start_points
        # A point farther right in the right image is farther left if both images are mirrored.
        mirrored = replace(
            measured, left=_mirror_image(measured.left), right=_mirror_image(measured.right)
        )
        mirrored_corners = (np.array([measured.left.shape[1] - 1, 0]) + corners * [-1, 1]).astype(
            np.float32
        )
        if _count_disparities(mirrored, mirrored_corners, config) > max(
            self._config.min_start_points, 2 * num_found
        ):
            raise RecordingError(
                f"{self._recording}: left and right pictures are swapped: {frame.name} shows points"
                " further right in right"
            )
        if num_found < self._config.min_start_points:
            assert measured.view.right_grey is not None
            coarse, _ = track_points(
                measured.view.grey,
                measured.view.right_grey,
                corners,
                corners,
                self._config.tracking,
            )
            self._match_in_right_image(measured, corners, coarse)
        self._has_started = num_found >= self._config.min_start_points
        return self._has_started

    def check_keyframe(
        self, keyframe: KeyFrame, landmarks: Landmarks, measured: MeasuredView
    ) -> None:
        """Match landmarks of a new key frame in the right image and compare them with their
        predictions."""
        if measured.right is None or measured.view.rig is None:
            return
        seen = keyframe.observations
        rows = np.flatnonzero(seen.active & (seen.weights[:, 2] > 0.0))
        rows = rows[:: max(1, len(rows) // self._config.sampled_points)]
        if len(rows) == 0:
            return
        at_infinity = measured.view.rig.left.cx - measured.view.rig.right.cx
        to_right = np.column_stack([-seen.measured[rows, 2] - at_infinity, np.zeros(len(rows))])
        points = seen.measured[rows, :2]
        found = self._match_in_right_image(
            measured, points.astype(np.float32), (points + to_right).astype(np.float32)
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
        if len(self._vertical_px) < self._config.min_keyframes:
            return
        vertical = float(np.median(self._vertical_px))
        if vertical > self._config.max_vertical_px:
            raise RecordingError(
                f"{self._recording}: left and right pictures are no pairs: the same points are"
                f" {vertical:.1f} px apart vertically (median); taken at different moments, or"
                " calibrated wrongly?"
            )

    def _match_in_right_image(
        self,
        measured: MeasuredView,
        points: Float32[np.ndarray, "n 2"],
        guesses: Float32[np.ndarray, "n 2"],
    ) -> Float[np.ndarray, "n 2"]:
        """Match points of the left image in the right one, also vertically, and record the vertical
        median.

        Return their pixels, NaN if not found.
        """
        assert measured.right is not None
        found = align_with_reference(
            measured.left,
            measured.right,
            points,
            guesses,
            np.ones(len(points), np.float32),
            self._config.tracking,
        )
        places = np.where(found.is_matched[:, None], found.points_img, np.nan).astype(np.float64)
        if np.count_nonzero(found.is_matched) >= max(10, len(points) // 3):
            self._vertical_px.append(float(np.nanmedian(np.abs(places[:, 1] - points[:, 1]))))
        return places


def _mirror_image(image: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    return np.ascontiguousarray(image[:, ::-1])


def _count_disparities(
    measured: MeasuredView, corners: Float32[np.ndarray, "n 2"], config: DisparityConfig
) -> int:
    return int(
        np.isfinite(
            measure_disparities(measured, corners, np.full(len(corners), np.nan), config)[0]
        ).sum()
    )
