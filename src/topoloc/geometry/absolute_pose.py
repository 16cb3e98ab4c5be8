"""Estimate a camera pose and its covariance from 2-D/3-D matches: robust PnP.

`method="poselib"` draws samples (`pose_sampling`), sorted if priorities are given. A robust
refinement then weighs each match by the uncertainty of its pixel and of its point.
`method="opencv"` is the paper's method, section III-B: OpenCV's RANSAC with EPnP and
Levenberg-Marquardt refinement on the inliers.

The covariance assumes independent errors. If a chair was moved or the depth of a wall is wrong, the
errors of all its points pull the pose in one direction. Then the summed gradient of an image cell
is larger than that of independent errors. The inflation is the ratio of two covariances of the
pose: the clustered "sandwich" and the plain one (Liang and Zeger, *Longitudinal data analysis using
generalized linear models*, 1986).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from topoloc.bounds import Above, Between
from topoloc.geometry.camera import Camera
from topoloc.geometry.joint_camera.camera_hypotheses import CameraBelief
from topoloc.geometry.pose_matches import (
    CAUCHY_SCALE,
    MIN_POINTS,
    PoseMatches,
    cells_of,
    score_gradients,
)
from topoloc.geometry.pose_sampling import Sampling, sample_absolute_pose
from topoloc.geometry.rigid import Rigid3

MAX_THRESHOLD_SCALE = 3.0
# OpenCV would need a second for the iterations that PoseLib runs in milliseconds.
_OPENCV_MAX_ITERATIONS = 1000
_OPENCV_CONFIDENCE = 0.99  # its default
_MIN_CELLS = 6  # with fewer occupied cells no inflation is estimated


@dataclass(frozen=True)
class AbsolutePoseConfig:
    """Hold the settings of pose estimation from 2-D/3-D matches."""

    method: Literal["poselib", "opencv"] = "poselib"
    """PoseLib's RANSAC, or OpenCV's old one, which stops at 1000 iterations or a confidence of 0.99
    and has no seed. For an uncalibrated camera PoseLib is always used. Where PoseLib has no package
    (Linux on ARM), OpenCV's USAC stands in for it."""
    max_reprojection_error_px: Annotated[float, Above(0)] = 4.0
    """Inlier threshold. With poselib the projected uncertainty of a point widens it up to
    threefold, in proportion to the standard deviation that it adds to `sigma_px`."""
    sigma_px: Annotated[float | None, Above(0)] = None
    """Standard deviation of a matched key point along x and along y. Unset: that of the feature
    type, or one pixel."""
    max_iterations: Annotated[int, Between(1, 1_000_000)] = 3000
    """Maximum number of RANSAC iterations."""
    min_iterations: Annotated[int, Between(0, 1_000_000)] = 50
    """Minimum number of RANSAC iterations."""
    seed: Annotated[int, Between(0, 1_000_000_000)] = 0
    """Seed of RANSAC's samples."""

    @property
    def key_point_sigma_px(self) -> float:
        """Return `sigma_px`, or one pixel if it is unset."""
        return 1.0 if self.sigma_px is None else self.sigma_px

    @property
    def inlier_limits(self) -> tuple[float, float]:
        """Return the inlier threshold in pixels, and how many times uncertain points widen it."""
        max_scale = 1.0 if self.method == "opencv" else MAX_THRESHOLD_SCALE
        return self.max_reprojection_error_px, max_scale

    def sampling(self, is_sorted: bool = False) -> Sampling:
        """Return how samples are drawn."""
        least, most = self.min_iterations, self.max_iterations
        return Sampling(self.max_reprojection_error_px, least, most, self.seed, is_sorted)


@dataclass(frozen=True, eq=False)
class AbsolutePose:
    """Hold a pose and its inliers among n matches. `covariance` is of the left perturbation
    (translation, rotation; m, rad). It includes that of `camera`, if the camera was estimated."""

    cam_from_world: Rigid3
    inliers: Bool[np.ndarray, " n"]
    covariance: Float[np.ndarray, "6 6"]
    camera: CameraBelief | None = None

    def inflated(self, factor: float) -> Float[np.ndarray, "6 6"]:
        """Return the covariance if errors that all matches share move the pose, not the camera."""
        camera = 0.0 if self.camera is None else self.camera.covariance
        return factor * (self.covariance - camera) + camera

    def noise_share(self, factor: float) -> float:
        """Return the share of the inflated position variance that is independent from image to
        image."""
        camera = 0.0 if self.camera is None else np.trace(self.camera.covariance[:3, :3])
        noise = np.trace(self.covariance[:3, :3]) - camera
        return float(noise / (factor * noise + camera))


def estimate_absolute_pose(
    points_img: Float[np.ndarray, "n 2"],
    points_world: Float[np.ndarray, "n 3"],
    camera: Camera,
    config: AbsolutePoseConfig | None = None,
    *,
    point_covariances: Float[np.ndarray, "n 3 3"] | None = None,
    priorities: Float[np.ndarray, " n"] | None = None,
    start: Rigid3 | None = None,
) -> AbsolutePose | None:
    """Return cam_from_world from n matches of pixels with world points (metres), or None if no pose
    is found.

    Args:
        point_covariances: covariances of the world points in the world frame (m^2). Default: exact
            points.
        priorities: larger values are more likely right, and RANSAC samples them first (not with
            OpenCV).
        start: an approximate pose. It is refined, and no other pose is searched.

    Matches with a value that is not finite are outliers. The same input gives a byte-identical
    result.
    """
    config, normalized = config or AbsolutePoseConfig(), camera.normalized_from_img(points_img)
    usable = np.isfinite(normalized).all(axis=1) & np.isfinite(points_world).all(axis=1)
    if point_covariances is not None:
        usable &= np.isfinite(point_covariances).all(axis=(1, 2))
    order = np.flatnonzero(usable)
    if priorities is not None:
        order = order[np.argsort(-priorities[order], kind="stable")]
    covariances = np.zeros((0, 3, 3)) if point_covariances is None else point_covariances[order]
    pixels, sigma_px = points_img[order], config.key_point_sigma_px
    matches = PoseMatches.from_pixels(
        pixels, points_world[order], covariances, camera, sigma_px, normalized[order]
    )
    if not matches.can_fix_pose():
        return None
    num_rounds = 2
    if start is None:
        # The solvers get a pinhole of the same focal length and undistorted pixels. So thresholds
        # keep their meaning and all camera models work alike. PoseLib adds no half pixel of its
        # own.
        undistorted = matches.normalized * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        solved = undistorted, matches.points_world, camera, config
        if config.method == "opencv":
            start, num_rounds = _solve_with_opencv(*solved), 0
        else:
            sampling = config.sampling(priorities is not None)
            start, *_ = sample_absolute_pose(undistorted, *solved[1:3], sampling) or (None,)
    found = start and matches.fit(start, *config.inlier_limits, num_rounds)
    return found and _pose_of_all(found, order, len(points_img))


def refine_absolute_pose(
    points_img: Float[np.ndarray, "n 2"],
    points_world: Float[np.ndarray, "n 3"],
    point_covariances: Float[np.ndarray, "n 3 3"],
    sigmas_px: Float[np.ndarray, " n"],
    camera: Camera,
    start: Rigid3,
    max_error_px: float,
) -> AbsolutePose | None:
    """Refine cam_from_world on matches that each have a standard deviation of their own (pixels).
    If residuals are smaller than these, so is the covariance.

    A match is an inlier if its reprojection error is at most `max_error_px`, even if its point is
    uncertain: `start` must be accurate to about that. None if too few matches are inliers.
    """
    normalized = camera.normalized_from_img(points_img)
    rows = np.flatnonzero(np.isfinite(normalized).all(axis=1))
    matches = PoseMatches.from_pixels(
        points_img[rows],
        points_world[rows],
        point_covariances[rows],
        camera,
        sigmas_px[rows],
        normalized[rows],
    )
    # a second round changes nothing: the loss is robust, and the start is near
    found = matches.fit(start, max_error_px, num_rounds=1, min_noise_scale=0.1)
    return found and _pose_of_all(found, rows, len(points_img))


def _pose_of_all(
    found: tuple[Rigid3, Bool[np.ndarray, " m"], Float[np.ndarray, "6 6"]],
    rows: Int[np.ndarray, " m"],
    num_points: int,
) -> AbsolutePose:
    """Return a pose fitted to these rows of the points, with the inliers among all points."""
    cam_from_world, active, covariance = found
    inliers = np.zeros(num_points, dtype=np.bool_)
    inliers[rows] = active
    return AbsolutePose(cam_from_world, inliers, covariance)


def _solve_with_opencv(
    undistorted: np.ndarray, points_world: np.ndarray, camera: Camera, config: AbsolutePoseConfig
) -> Rigid3 | None:
    matrix = camera.matrix()
    try:
        found, rotation, translation, idx = cv2.solvePnPRansac(
            points_world,
            undistorted,
            matrix,
            None,
            iterationsCount=min(config.max_iterations, _OPENCV_MAX_ITERATIONS),
            reprojectionError=config.max_reprojection_error_px,
            confidence=_OPENCV_CONFIDENCE,
            flags=cv2.SOLVEPNP_EPNP,
        )
        if not found or idx is None or len(idx) < MIN_POINTS:
            return None
        rows = np.sort(np.asarray(idx, dtype=np.intp)[:, 0])
        rotation, translation = cv2.solvePnPRefineLM(
            points_world[rows], undistorted[rows], matrix, None, rotation, translation
        )
    except cv2.error:  # thrown for some degenerate samples
        return None
    if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
        return None
    return Rigid3(cv2.Rodrigues(rotation)[0], translation[:, 0].copy())


def compute_variance_inflation(
    points_img: Float[np.ndarray, "n 2"],
    points_world: Float[np.ndarray, "n 3"],
    point_covariances: Float[np.ndarray, "n 3 3"],
    camera: Camera,
    cam_from_world: Rigid3,
    sigma_px: float | Float[np.ndarray, " n"],
    cells: Int[np.ndarray, " n"] | None = None,
) -> float:
    """Return the ratio of the pose's variance to that under independent errors of the inliers. It
    is averaged over the six directions and at least 1.

    If the inliers lie in fewer than six cells, the ratio is 1.

    Args:
        points_img: pixels of the inliers.
        points_world: world points of the inliers (metres).
        point_covariances: covariances of these points (m^2).
        sigma_px: standard deviation of the pixels.
        cells: the cell of each inlier, within which errors may be shared. None: of the image.
    """
    matches = PoseMatches.from_pixels(points_img, points_world, point_covariances, camera, sigma_px)
    if cells is None:
        cells = cells_of(points_img, camera.width, camera.height)
    used, cells = np.unique(cells, return_inverse=True)
    if len(used) < _MIN_CELLS:
        return 1.0
    information, gradients = score_gradients(*matches.kernel_args(cam_from_world), CAUCHY_SCALE)
    if not (
        np.isfinite(information).all() and np.linalg.matrix_rank(information, hermitian=True) == 6
    ):
        return 1.0
    # The pose is fitted to the same matches, which makes the sums smaller.
    fit_correction = len(used) / (len(used) - 3.0)
    gradients -= gradients.mean(axis=0)
    clustered = np.column_stack([np.bincount(cells, column) for column in gradients.T])
    variance_alone, variance_together = (
        np.trace(np.linalg.solve(information, each.T @ each)) for each in (gradients, clustered)
    )
    if variance_alone <= 0.0:
        return 1.0
    return max(1.0, float(fit_correction * variance_together / variance_alone))
