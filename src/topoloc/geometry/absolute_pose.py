"""The pose of a camera from matches of its pixels with points of the world: robust PnP, and how far
to trust it.

`method="poselib"`: PoseLib's LO-RANSAC with P3P (Persson and Nordberg, 2018;
https://github.com/PoseLib/PoseLib), PROSAC ordering (Chum and Matas, 2005) where priorities are
given, then a robust refinement that weighs every match by the uncertainty of both its pixel and its
point. `method="opencv"`: the paper's own variant, section III-B: OpenCV's RANSAC with EPnP and
Levenberg-Marquardt refinement on the inliers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import cv2
import numpy as np
import poselib
from jaxtyping import Bool, Float

from topoloc.bounds import Above, Between
from topoloc.geometry.absolute_pose_kernels import normal_equations, refine, squared_errors
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3

_Array = np.ndarray
_MIN_POINTS = 4
_MAX_THRESHOLD_SCALE = 3.0
# OpenCV draws five points a sample and refines no candidate: what PoseLib does in milliseconds
# would take it a second.
_OPENCV_MAX_ITERATIONS = 1000
_OPENCV_CONFIDENCE = 0.99  # its default
_MAX_SCALE_STEPS = 30
CAUCHY_SCALE = 2.3849  # 95 % efficiency on Gaussian residuals (Holland and Welsch, 1977)
# What Cauchy's weights w do to Gaussian residuals r of two dimensions, so that the covariance is
# not biased by them: E[w r^2] / 2, and E[w] E[w^2 r^2 / 2] / E[w - w^2 r^2 / c^2]^2, the
# M-estimator's variance over
# the inverse of its information.
_MEAN_WEIGHTED_SQUARE = 0.6302
_ESTIMATOR_VARIANCE = 0.8265


@dataclass(frozen=True)
class AbsolutePoseConfig:
    """How a pose is found from 2-D/3-D matches."""

    method: Literal["poselib", "opencv"] = "poselib"
    """PoseLib's RANSAC, or OpenCV's, which ends at 1000 iterations or a confidence of 0.99 and
    takes no seed. Of a camera that nobody has calibrated always PoseLib's."""
    max_reprojection_error_px: Annotated[float, Above(0)] = 4.0
    """Matches that miss by less are inliers. With poselib the uncertainty of a point, projected,
    widens it up to threefold: in proportion to the standard deviation that it adds to
    `sigma_px`."""
    sigma_px: Annotated[float | None, Above(0)] = None
    """Standard deviation of a matched key point along x and along y. Unset: that of the kind of
    features, or one pixel."""
    max_iterations: Annotated[int, Between(1, 1_000_000)] = 3000
    """Of RANSAC, at most."""
    min_iterations: Annotated[int, Between(0, 1_000_000)] = 50
    """Of RANSAC, at least."""
    confidence: Annotated[float, Between(0, 1)] = 0.999
    """RANSAC ends where it is so sure that no better pose is left."""
    max_refinement_steps: Annotated[int, Between(0, 1000)] = 10
    """Of the least squares on the inliers."""
    seed: Annotated[int, Between(0, 1_000_000_000)] = 0
    """Of RANSAC's samples."""

    @property
    def key_point_sigma_px(self) -> float:
        return 1.0 if self.sigma_px is None else self.sigma_px


@dataclass(frozen=True, eq=False)
class AbsolutePose:
    """A pose with its inliers among n matches; `covariance` is of the left perturbation
    (translation, rotation; m, rad)."""

    cam_from_world: Rigid3
    inliers: Bool[np.ndarray, " n"]
    covariance: Float[np.ndarray, "6 6"]


@dataclass(frozen=True, eq=False)
class Matches:
    """The usable matches; pixels also on the plane z = 1, with their covariance there."""

    points_img: Float[np.ndarray, "n 2"]
    normalized: Float[np.ndarray, "n 2"]
    covariances: Float[np.ndarray, "n 2 2"]
    points_world: Float[np.ndarray, "n 3"]
    point_covariances: Float[np.ndarray, "n 3 3"] | Float[np.ndarray, "0 3 3"]

    @staticmethod
    def from_pixels(
        points_img: _Array,
        normalized: Float[np.ndarray, "n 2"],
        points_world: _Array,
        point_covariances: _Array,
        camera: Camera,
        sigma_px: float,
    ) -> Matches:
        """Pixels, with what they are on the plane z = 1 and their standard deviation, of world
        points (metres) and their covariances."""
        to_normalized = sigma_px * camera.normalized_jacobian(normalized)
        return Matches(
            points_img=np.ascontiguousarray(points_img, dtype=np.float64),
            normalized=normalized,
            covariances=to_normalized @ to_normalized.transpose(0, 2, 1),
            points_world=np.ascontiguousarray(points_world, dtype=np.float64),
            point_covariances=np.ascontiguousarray(point_covariances, dtype=np.float64),
        )

    def kernel_args(
        self, cam_from_world: Rigid3
    ) -> tuple[_Array, _Array, _Array, _Array, _Array, _Array]:
        """What all kernels take."""
        rotation, translation = (
            np.ascontiguousarray(cam_from_world.rotation),
            np.ascontiguousarray(cam_from_world.translation),
        )
        return (
            rotation,
            translation,
            self.normalized,
            self.covariances,
            self.points_world,
            self.point_covariances,
        )


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
    """cam_from_world from n matches of pixels with world points (metres); None where no pose
    follows from them.

    Args:
        point_covariances: of the world points, in the world frame (m^2); exact points without it.
        priorities: larger is likelier right; RANSAC tries these first (not with OpenCV).
        start: a pose that is nearly right already: it is refined, and no other one is sought.

    Matches with a value that is not finite are outliers. The same input gives the same bytes.
    """
    config = config or AbsolutePoseConfig()
    normalized = camera.normalized_from_img(points_img)
    usable = np.isfinite(normalized).all(axis=1) & np.isfinite(points_world).all(axis=1)
    if point_covariances is not None:
        usable &= np.isfinite(point_covariances).all(axis=(1, 2))
    order = np.flatnonzero(usable)
    if priorities is not None:
        order = order[np.argsort(-priorities[order], kind="stable")]
    covariances = np.zeros((0, 3, 3)) if point_covariances is None else point_covariances[order]
    matches = Matches.from_pixels(
        points_img[order],
        normalized[order],
        points_world[order],
        covariances,
        camera,
        config.key_point_sigma_px,
    )
    if not is_non_collinear(matches.points_world) or not is_non_collinear(
        np.insert(matches.normalized, 2, 0.0, axis=1)
    ):
        return None
    if start is not None:
        cam_from_world = _refine_on_inliers(start, matches, camera, config)
    else:
        solve = _solve_with_opencv if config.method == "opencv" else _solve_with_poselib
        cam_from_world = solve(matches, camera, config, priorities is not None)
    if cam_from_world is None:
        return None
    return _with_covariance(cam_from_world, matches, camera, config, order, len(points_img))


def _solve_with_poselib(
    matches: Matches, camera: Camera, config: AbsolutePoseConfig, is_sorted: bool
) -> Rigid3 | None:
    # A pinhole of the same focal length in pixels that are already undistorted: thresholds keep
    # their meaning, and every model works alike. PoseLib adds no half pixel of its own.
    undistorted = matches.normalized * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    found = estimate_pose_ransac(undistorted, matches.points_world, camera, config, is_sorted)
    return _refine_on_inliers(found[0], matches, camera, config) if found else None


def estimate_pose_ransac(
    undistorted: Float[np.ndarray, "n 2"],
    points_world: Float[np.ndarray, "n 3"],
    camera: Camera,
    config: AbsolutePoseConfig,
    is_sorted: bool = False,
) -> tuple[Rigid3, int, float] | None:
    """PoseLib's RANSAC alone, on n finite matches of pixels without distortion: cam_from_world, how
    many it misses by less than the threshold, and the sum of all squared errors (px^2), each at
    most the threshold's; None where the samples gave no pose. The points' uncertainty does not
    count.

    Args:
        is_sorted: the first matches are the likeliest right.
    """
    pinhole = {
        "model": "PINHOLE",
        "width": camera.width,
        "height": camera.height,
        "params": [camera.fx, camera.fy, camera.cx, camera.cy],
    }
    ransac = {
        "max_reproj_error": config.max_reprojection_error_px,
        "max_iterations": config.max_iterations,
        "min_iterations": config.min_iterations,
        "success_prob": config.confidence,
        # PoseLib's own 3 triples the time; its local optimisation finds as many poses without
        "dyn_num_trials_mult": 1.0,
        "progressive_sampling": is_sorted,
        "seed": config.seed,
    }
    bundle = {"max_iterations": 0}  # the refinement on the inliers replaces it
    pose, ransac_info = poselib.estimate_absolute_pose(
        undistorted, points_world, pinhole, ransac, bundle
    )
    matrix = np.asarray(pose.Rt, dtype=np.float64)
    if not np.isfinite(matrix).all():
        return None
    loss = (
        float(ransac_info["model_score"]) * ((camera.fx + camera.fy) / 2) ** 2
    )  # PoseLib's is on the plane z = 1
    return Rigid3(matrix[:, :3].copy(), matrix[:, 3].copy()), int(ransac_info["num_inliers"]), loss


def _refine_on_inliers(
    cam_from_world: Rigid3, matches: Matches, camera: Camera, config: AbsolutePoseConfig
) -> Rigid3 | None:
    for _ in range(2):  # the second time with the inliers of the first
        inliers = select_inliers(cam_from_world, matches, camera, config)
        if not is_non_collinear(matches.points_world[inliers]):
            return None
        cam_from_world = refine_pose(cam_from_world, matches, inliers, config.max_refinement_steps)
    return cam_from_world


def refine_pose(
    cam_from_world: Rigid3, matches: Matches, active: Bool[np.ndarray, " n"], max_steps: int
) -> Rigid3:
    """The pose at which the active matches fit best, from one nearby."""
    rotation, translation = refine(
        *matches.kernel_args(cam_from_world), active, CAUCHY_SCALE, max_steps
    )
    return Rigid3(rotation, translation)


def _solve_with_opencv(
    matches: Matches, camera: Camera, config: AbsolutePoseConfig, is_sorted: bool
) -> Rigid3 | None:
    del is_sorted  # OpenCV's RANSAC knows no order
    undistorted = matches.normalized * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    try:
        found, rotation, translation, idx = cv2.solvePnPRansac(
            matches.points_world,
            undistorted,
            camera.matrix(),
            None,
            iterationsCount=min(config.max_iterations, _OPENCV_MAX_ITERATIONS),
            reprojectionError=config.max_reprojection_error_px,
            confidence=min(config.confidence, _OPENCV_CONFIDENCE),
            flags=cv2.SOLVEPNP_EPNP,
        )
        if not found or idx is None or len(idx) < _MIN_POINTS:
            return None
        rows = np.sort(np.asarray(idx, dtype=np.intp)[:, 0])
        rotation, translation = cv2.solvePnPRefineLM(
            matches.points_world[rows],
            undistorted[rows],
            camera.matrix(),
            None,
            rotation,
            translation,
        )
    except cv2.error:  # thrown for some degenerate samples
        return None
    if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
        return None
    return Rigid3(cv2.Rodrigues(rotation)[0], translation[:, 0].copy())


def _with_covariance(
    cam_from_world: Rigid3,
    matches: Matches,
    camera: Camera,
    config: AbsolutePoseConfig,
    order: np.ndarray,
    num_points: int,
) -> AbsolutePose | None:
    active = select_inliers(cam_from_world, matches, camera, config)
    if np.count_nonzero(active) < _MIN_POINTS or not is_non_collinear(matches.points_world[active]):
        return None
    scale = _estimate_noise_scale(squared_errors(*matches.kernel_args(cam_from_world))[active])
    information, *_ = normal_equations(
        *matches.kernel_args(cam_from_world), active, CAUCHY_SCALE * scale, 6
    )
    inverse = _invert_information(information)
    if inverse is None:
        return None
    covariance = _ESTIMATOR_VARIANCE * scale**2 * inverse
    inliers = np.zeros(num_points, dtype=np.bool_)
    inliers[order] = active
    return AbsolutePose(cam_from_world, inliers, covariance)


def _estimate_noise_scale(squares: Float[np.ndarray, " n"]) -> float:
    """How many times larger than assumed the noise is, at least 1, of squared whitened residuals
    (Huber's proposal 2, 1964).

    Never below 1: that few matches fit well is chance, or the fit itself.
    """
    num_free = max(2 * len(squares) - 6, 1)
    variance = 1.0
    for _ in range(_MAX_SCALE_STEPS):
        scaled = squares / variance
        ratio = float(np.sum(scaled / (1.0 + scaled / CAUCHY_SCALE**2))) / (
            _MEAN_WEIGHTED_SQUARE * num_free
        )
        if ratio <= 1.001:
            break
        variance *= ratio
    return float(np.sqrt(variance))


def _invert_information(information: Float[np.ndarray, "6 6"]) -> Float[np.ndarray, "6 6"] | None:
    """Its inverse, None where it does not fix all six degrees of freedom."""
    diagonal = np.sqrt(np.diag(information))
    if not (np.isfinite(information).all() and np.all(diagonal > 0.0)):
        return None
    scales = np.outer(diagonal, diagonal)  # makes metres and radians comparable
    if np.linalg.eigvalsh(information / scales)[0] < 1e-12:
        return None
    inverse = np.linalg.inv(information / scales) / scales
    return (inverse + inverse.T) / 2.0


def select_inliers(
    cam_from_world: Rigid3, matches: Matches, camera: Camera, config: AbsolutePoseConfig
) -> Bool[np.ndarray, " n"]:
    """The matches that this pose explains: by the threshold, and, of uncertain points, by what they
    may miss it by."""
    errors_px = np.linalg.norm(
        camera.img_from_cam(cam_from_world.apply(matches.points_world)) - matches.points_img, axis=1
    )
    limit_px = (
        config.max_reprojection_error_px
    )  # NaN, behind the camera or outside its field, is not below it
    if config.method == "opencv" or len(matches.point_covariances) == 0:
        return errors_px <= limit_px
    # A plain threshold would cut the errors of uncertain points short, and what is left would look
    # too precise.
    squares = squared_errors(*matches.kernel_args(cam_from_world))
    return (squares <= (limit_px / config.key_point_sigma_px) ** 2) & (
        errors_px <= _MAX_THRESHOLD_SCALE * limit_px
    )


def is_non_collinear(points: Float[np.ndarray, "n 3"]) -> bool:
    """At least four points, not all on a line."""
    if len(points) < _MIN_POINTS:
        return False
    centred = points - points.mean(axis=0)
    scatter = (
        centred.T @ centred
    )  # of variances a <= b <= c: trace^2 - |scatter|^2 is 2 (ab + ac + bc), between 2 bc and 6 bc
    total = float(np.trace(scatter)) ** 2
    return total - float(np.vdot(scatter, scatter)) > 2e-9 * total
