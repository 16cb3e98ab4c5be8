"""Measure the disparity between left and right image at points, to a fraction of a pixel. Depth
images are converted to disparity.

SLAM uses disparity only: its noise hardly depends on depth, and distant points do no harm. A depth
image is converted to the disparity that a second camera 8 cm to the right would measure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Float32

from topoloc.errors import RecordingError
from topoloc.features.parallel import parallel_for_rows
from topoloc.geometry.camera import Camera
from topoloc.points.epipolar_kernels import match_in_ranges
from topoloc.points.metric_points import measure_depths
from topoloc.recordings.frame import StereoFrame
from topoloc.recordings.frame_preparation import PreparedFrame, prepare_frame

_DEPTH_BASELINE = 0.08
_MIN_DEPTH_SIGMA_PX = 0.03


@dataclass(frozen=True)
class StereoCamera:
    """Hold a pinhole that also measures disparity: ``disparity = bf / depth``, bf in pixels times
    metres."""

    camera: Camera
    bf: float

    def points_cam(self, measured: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return points (metres) of pixels and disparities (x, y, d). Rows are NaN if d is unknown
        or not positive."""
        z = self.bf / np.where(measured[:, 2] > 0.0, measured[:, 2], np.nan)
        return np.column_stack([self.camera.normalized_from_img(measured[:, :2]) * z[:, None], z])

    def project(self, points_cam: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return (x, y, d) of points in the camera's frame (metres), NaN for points behind it."""
        z = np.where(points_cam[:, 2] > 1e-9, points_cam[:, 2], np.nan)
        return np.column_stack([self.camera.img_from_cam(points_cam), self.bf / z])


@dataclass(frozen=True, eq=False)
class MeasuredView:
    """Hold a prepared frame with its stereo camera. `left` and `right` are its images as floats."""

    view: PreparedFrame
    stereo: StereoCamera
    left: Float32[np.ndarray, "h w"]
    right: Float32[np.ndarray, "h w"] | None


def measured_view(frame: StereoFrame) -> MeasuredView:
    """Prepare a frame for measurements, with depth of every pixel. Raises CalibrationError and
    RecordingError like `prepare_frame`."""
    view = prepare_frame(frame)
    if view.depth is not None and not view.is_located:
        # Tracks need many points on slanted walls more than they need the right sigmas of edges.
        depth = cv2.resize(view.depth, view.grey.shape[::-1], interpolation=cv2.INTER_LINEAR)
        view = replace(view, depth=depth)
    left = view.grey.astype(np.float32)
    baseline, right = _DEPTH_BASELINE, None
    if view.right_grey is not None and view.rig is not None:
        baseline, right = view.rig.baseline, view.right_grey.astype(np.float32)
    return MeasuredView(view, StereoCamera(view.camera, view.camera.fx * baseline), left, right)


def measure_disparities(
    measured: MeasuredView,
    points_img: Float32[np.ndarray, "n 2"],
    guesses_px: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the disparity of points of the left image and its standard deviation, pixels. The
    disparity of an infinitely distant point is 0.

    A point with a guess (not NaN) is searched around it, others on the whole row. Points without a
    result are NaN.
    """
    max_share_of_width = 0.2  # maximum disparity, as a fraction of the image width
    search_px = 4  # search range on either side of a disparity guess
    half_px = 5  # half side of the window that is correlated along the row
    min_correlation = 0.8  # minimum normalised correlation of the two images
    max_second_correlation = 0.95  # at another place, of the best: else the point is ambiguous
    min_sigma_px = 0.15  # that calibration and interpolation leave at perfect correlation
    max_sigma_px = 1.0  # disparities with a larger standard deviation are not used
    left, right, rig = measured.left, measured.right, measured.view.rig
    if measured.view.depth is not None:
        depth, sigma_z = measure_depths(measured.view.depth, left.shape, points_img)
        sigmas = measured.stereo.bf / depth**2 * sigma_z
        return measured.stereo.bf / depth, np.maximum(sigmas, _MIN_DEPTH_SIGMA_PX)
    if right is None or rig is None:
        raise RecordingError("disparities need a stereo pair or a depth image")
    at_infinity = rig.left.cx - rig.right.cx
    largest = int(measured.view.camera.width * max_share_of_width)
    known = np.isfinite(guesses_px)
    nearest = np.floor(np.nan_to_num(guesses_px) + at_infinity) - search_px
    min_disparities = np.where(known, nearest, 0.0).clip(0, largest).astype(np.int64)
    range_lengths = np.where(known, 2 * search_px + 2, largest + 1)
    disparities, sigmas = np.empty((2, len(points_img)), np.float32)
    # Distribute the long searches evenly over the threads.
    order = np.argsort(range_lengths, kind="stable")
    order = np.concatenate([order[0::2], order[1::2]])
    points, lows, lengths = points_img[order], min_disparities[order], range_lengths[order]

    def run(first: int, last: int) -> None:
        part = slice(first, last)
        match_in_ranges(
            left, right, points[part], lows[part], lengths[part], half_px,
            min_correlation, max_second_correlation, disparities[part], sigmas[part],
        )  # fmt: skip

    parallel_for_rows(run, len(points))
    found, found_sigmas = np.full(len(points), np.nan), np.full(len(points), np.nan)
    found[order] = disparities.astype(np.float64) - at_infinity
    found_sigmas[order] = np.hypot(sigmas.astype(np.float64), min_sigma_px)
    good = (found > 0.0) & (found_sigmas < max_sigma_px)
    return np.where(good, found, np.nan), np.where(good, found_sigmas, np.nan)
