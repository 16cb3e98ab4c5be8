"""Measure the disparity between left and right image at points, to a fraction of a pixel. Depth
images are converted to disparity.

SLAM uses disparity only: its noise hardly depends on depth, and distant points do no harm. A depth
image is converted to the disparity that a second camera 8 cm to the right would measure.

Maps use 3-D positions of a frame's features with covariances. These points are dropped:

* Points without a distinct match in the other camera, and depths beside a jump in depth. Such a
  position may be that of another surface. It lies on the right ray, so that a robust estimator
  does not detect it.
* Points whose relative depth uncertainty is large. As the query moves away from the node, they
  move along their ray by more than the inlier threshold. Their first-order covariance is then no
  longer valid.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from topoloc.errors import RecordingError
from topoloc.features.features import Features
from topoloc.features.parallel import parallel_for_rows
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import (
    StereoRig,
    depth_from_disparity,
    depth_sigmas,
    depth_sigmas_of_disparity,
    points_from_depth,
    ray_covariances,
)
from topoloc.points.epipolar_kernels import match_in_ranges
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


# SURF and SIFT describe a neighbourhood of 20 s and 12 sigma; both report sizes of about 7.5 scales
# across.
SCALES_PER_SIZE = 1.2 / 9.0


@dataclass(frozen=True, eq=False)
class MetricPoints:
    """Hold one 3-D point per feature, in the features' order. `points_cam` is in metres. Rows are
    NaN where `valid` is False."""

    points_cam: Float[np.ndarray, "n 3"]
    covariances: Float[np.ndarray, "n 3 3"]
    valid: Bool[np.ndarray, " n"]


def locate_points(features: Features, view: PreparedFrame) -> MetricPoints:
    """Return the 3-D positions (camera frame of the view) of `features`, which were detected in
    `view.grey`.

    Raises:
        RecordingError: the view has neither a right image nor depth.
    """
    if view.right_grey is not None and view.rig is not None:
        points_cam, sigma_z = _points_from_stereo(features, view.grey, view.right_grey, view.rig)
    elif view.depth is not None:
        depth, sigma_z = measure_depths(view.depth, view.grey.shape, features.points_img)
        points_cam = points_from_depth(features.points_img.astype(np.float64), depth, view.camera)
    else:
        raise RecordingError("3-D positions need a stereo pair or a depth image")
    return select_certain_points(points_cam, sigma_z, view.camera, keypoint_sigmas(features))


def select_certain_points(
    points_cam: Float[np.ndarray, "n 3"],
    sigma_z: Float[np.ndarray, " n"],
    camera: Camera,
    sigmas_px: Float[np.ndarray, " n"],
    max_relative_sigma: float = 0.3,
) -> MetricPoints:
    """Return the points with their covariances, without points of uncertain depth.

    Args:
        sigma_z: standard deviations of the depths, metres.
        sigmas_px: standard deviations of the key points.
        max_relative_sigma: points whose depth has a larger standard deviation than this fraction of
            it are dropped.
    """
    with np.errstate(invalid="ignore"):
        valid = sigma_z < max_relative_sigma * points_cam[:, 2]
    valid &= np.isfinite(points_cam).all(axis=1)
    covariances = np.full((len(points_cam), 3, 3), np.nan)
    covariances[valid] = ray_covariances(
        points_cam[valid], sigma_z[valid], camera, sigmas_px[valid]
    )
    return MetricPoints(np.where(valid[:, None], points_cam, np.nan), covariances, valid)


def keypoint_sigmas(features: Features) -> Float[np.ndarray, " n"]:
    """Return the standard deviation (pixels) of each key point's position. It grows with the key
    point's scale."""
    sigma_scale = 0.4  # standard deviation of a key point's position, in units of its scale
    return np.maximum(sigma_scale * SCALES_PER_SIZE * features.sizes_px.astype(np.float64), 0.3)


def _points_from_stereo(
    features: Features,
    left: UInt8[np.ndarray, "h w"],
    right: UInt8[np.ndarray, "h w"],
    rig: StereoRig,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    half_px = 5  # half side of the window that is correlated along the row
    min_correlation = 0.8  # minimum normalised correlation of the two images
    # A point is ambiguous if a second place on the row reaches this fraction of the best
    # correlation.
    max_second_correlation = 0.97
    min_sigma_px = 0.12  # that calibration and interpolation leave even at perfect correlation
    # Points with a disparity above a quarter of the image width are too near to be visible well in
    # both cameras.
    max_disparity, num = max(16, rig.left.width // 4), len(features)
    disparity, sigma = np.empty(num, np.float32), np.empty(num, np.float32)
    match_in_ranges(
        left.astype(np.float32), right.astype(np.float32), features.points_img, np.zeros(num, np.int64),  # noqa: E501
        np.full(num, max_disparity + 1), half_px, min_correlation, max_second_correlation,
        disparity, sigma,
    )  # fmt: skip
    depth = depth_from_disparity(disparity.astype(np.float64), rig)
    sigma_z = depth_sigmas_of_disparity(depth, np.hypot(sigma, min_sigma_px, dtype=float), rig)
    return points_from_depth(features.points_img.astype(np.float64), depth, rig.left), sigma_z


def measure_depths(
    depth: Float32[np.ndarray, "h w"], shape: tuple[int, ...], points_img: np.ndarray
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the depths at pixels of an image of `shape`, with their standard deviations, metres.
    `depth` may be coarser than the image. Unknown depths are NaN."""
    if depth.shape == shape:
        smooth = _smooth_depth(depth, points_img)
        return smooth, depth_sigmas(smooth)
    scale = np.array(depth.shape[::-1]) / np.array(shape[::-1])
    return _fit_coarse_depth(depth, (points_img + 0.5) * scale - 0.5)


def _smooth_depth(
    depth: np.ndarray, points_img: np.ndarray, max_step: float = 0.05
) -> Float[np.ndarray, " n"]:
    """Return the mean depth of the 5x5 neighbourhood of each pixel. It is NaN at depth edges, where
    the neighbourhood spreads by more than `max_step` (fraction of depth), and if half of the
    neighbourhood is unknown."""
    window = _neighbourhoods(depth, points_img, 2)[0]
    known = np.isfinite(window)
    enough = known.sum(axis=1) >= 13
    mean = np.where(known, window, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    nearest = np.where(known, window, np.inf).min(axis=1)
    farthest = np.where(known, window, -np.inf).max(axis=1)
    return np.where(enough & (farthest - nearest <= max_step * mean), mean, np.nan)


def _fit_coarse_depth(
    depth: np.ndarray, points: np.ndarray
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the depths at `points` (pixels of `depth`) and their standard deviations, from a plane
    through the 7x7 neighbourhood. Depth is NaN if half of that is unknown.

    A coarse sensor interpolates few dots, so an edge is a ramp of several pixels. There the true
    depth is off by about the largest residual of the plane. Other images decide.
    """
    sensor_noise = 0.01  # of depth, that of lidars in phones between 1 and 5 m
    window, offsets = _neighbourhoods(depth, points, 3)
    with np.errstate(divide="ignore"):
        inverse = 1.0 / window  # of a plane, this is linear in the pixels
    known = np.isfinite(inverse)
    enough = known.sum(axis=1) >= 25
    terms = known[:, :, None] * np.concatenate([np.ones_like(offsets[:, :, :1]), offsets], axis=2)
    inverse = np.where(known, inverse, 0.0)
    normal = np.where(enough[:, None, None], terms.transpose(0, 2, 1) @ terms, np.eye(3))
    plane = np.linalg.solve(normal, terms.transpose(0, 2, 1) @ inverse[:, :, None])
    residuals = np.abs(inverse - (terms @ plane)[:, :, 0]).max(axis=1)
    nearness = np.where(enough & (plane[:, 0, 0] > 0.0), plane[:, 0, 0], np.nan)
    z = 1.0 / nearness
    return z, np.sqrt((residuals * z**2) ** 2 + (sensor_noise * z) ** 2 + depth_sigmas(z) ** 2)


def _neighbourhoods(
    depth: np.ndarray, points: np.ndarray, half: int
) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, "n k 2"]]:
    """Return the depths of the square of `2 half + 1` pixels around each point, and the offsets of
    their pixels (x, y) from the point."""
    height, width = depth.shape
    steps = np.arange(-half, half + 1)
    square = np.column_stack([np.tile(steps, len(steps)), np.repeat(steps, len(steps))])
    pixels = np.rint(points).astype(np.int64)[:, None] + square
    inside = np.clip(pixels, 0, [width - 1, height - 1])
    window = depth[inside[:, :, 1], inside[:, :, 0]].astype(np.float64)
    return window, inside - points[:, None]
