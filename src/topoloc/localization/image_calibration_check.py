"""Check the camera against one image: its calibration, and whether it turned while its rows were
read.

A wrong calibration gives a wrong pose with a small covariance, and a camera that turned shears its
image, but the residuals of the points show such errors. One linear step asks whether they do. If
so, pose and camera are fitted together, and the likeliest hypothesis is believed
(`geometry/joint_camera/`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
from jaxtyping import Float, Float32

from topoloc.geometry.absolute_pose import MAX_THRESHOLD_SCALE
from topoloc.geometry.calibration_check import (
    CalibrationConsistency,
    CalibrationMismatch,
    IntrinsicsDeviation,
    check_calibration_consistency,
    corrected_camera,
)
from topoloc.geometry.camera import Camera, UncalibratedCamera
from topoloc.geometry.joint_camera.camera_hypotheses import (
    CameraBelief,
    CameraHypothesis,
    CameraPrior,
    unchanged_camera,
)
from topoloc.geometry.joint_camera.joint_fit import (
    CameraObservations,
    JointFit,
    estimate_intrinsics,
    fit_camera,
    fit_jointly,
    linearized_fit,
    refit_camera,
    row_times,
    weigh_poses,
)
from topoloc.geometry.rigid import Rigid3
from topoloc.geometry.squeezed_image import is_scaled_apart
from topoloc.localization.pose_fit import PointObservations, PoseFit
from topoloc.localization.result import Localization, NotLocalized
from topoloc.localization.search import Search

_AS_CALIBRATED, _OTHER_INTRINSICS = CameraHypothesis(), CameraHypothesis(False, "xy")


@dataclass(frozen=True, eq=False)
class SeenCamera:
    """Hold the camera that an image shows instead of its calibration, and the pose by it.

    The amount of distortion is in the pose, not in `camera`. `rotation` (radians, camera axes) is
    that from the first to the last row. The pose is that of the middle row.
    """

    camera: Camera
    cam_from_world: Rigid3
    belief: CameraBelief
    rotation: Float[np.ndarray, " 3"]

    def undo_rotation(self, points_img: Float32[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n 2"]:
        """Return where pixels would be if all rows were read with the middle one. Pixels without a
        ray stay."""
        if not self.rotation.any():
            return points_img
        pixels, camera = points_img.astype(np.float64), self.camera
        rays = np.insert(camera.normalized_from_img(pixels), 2, 1.0, axis=1)
        times = row_times(pixels, camera.height)
        moved = camera.img_from_cam(rays - times[:, None] * np.cross(self.rotation, rays))
        return np.where(np.isfinite(moved), moved, pixels).astype(np.float32)


@dataclass(frozen=True, eq=False)
class ImageCalibration:
    """Hold what an image shows of its camera: the deviation from the calibration, the camera if it
    is another one or turned, and the mismatch if the image contradicts the calibration."""

    seen: IntrinsicsDeviation | None = None
    other: SeenCamera | None = None
    doubt: CalibrationMismatch | None = None


def check_camera_calibrations(
    results: Iterable[Localization | NotLocalized],
) -> list[CalibrationConsistency]:
    """Combine the calibration estimates of all images of each camera.

    Cameras with too few estimates are left out.
    """
    by_camera: dict[Camera, dict[IntrinsicsDeviation, None]] = {}
    for result in results:
        if result.seen_camera is not None and result.provenance.camera is not None:
            by_camera.setdefault(result.provenance.camera, {})[result.seen_camera] = (
                None  # counts a repeated image once
            )
    verdicts = (
        check_calibration_consistency(list(seen), camera) for camera, seen in by_camera.items()
    )
    return [verdict for verdict in verdicts if verdict is not None]


def check_image_calibration(search: Search, fit: PoseFit, may_turn: bool) -> ImageCalibration:
    """Compare an image with its calibration (`compare_with_calibration`)."""
    if not _has_enough(fit):
        return ImageCalibration()
    max_error_px = MAX_THRESHOLD_SCALE * search.config.pose.max_reprojection_error_px
    found = compare_with_calibration(
        _observe(search, fit, fit.inlier_observations(1.0), math.inf),
        lambda: _observe(search, fit, fit.match_observations, max_error_px),
        fit.camera,
        fit.pose.cam_from_world,
        may_turn=may_turn,
        scale=search.query.scale,
    )
    return replace(found, seen=found.seen and replace(found.seen, place=fit.node_id))


def compare_with_calibration(
    inliers: CameraObservations,
    matches: Callable[[], CameraObservations],
    camera: Camera,
    cam_from_world: Rigid3,
    *,
    may_turn: bool,
    scale: float = 1.0,
) -> ImageCalibration:
    """Compare an image with its calibration, and with a camera that turned while a rolling shutter
    read its rows, if it `may_turn`.

    Args:
        inliers: those of the pose found with the calibration.
        matches: returns all matches: the pose by a wrong camera chose its inliers.
        scale: the original image is so many times as wide.
    """
    settled, contradicted = 0.9, 0.05  # probabilities of the calibration
    prior, unchanged = _prior(camera, may_turn), unchanged_camera()
    first = linearized_fit(inliers, cam_from_world, unchanged)
    if first is None:
        return ImageCalibration()
    if prior.weigh(first.likelihood)[_AS_CALIBRATED][0] >= settled:
        return ImageCalibration(_deviation(first))
    seen = matches()
    joint = fit_camera(seen, cam_from_world, unchanged, prior)
    other = joint and refit_camera(seen, joint, prior, _OTHER_INTRINSICS)
    if joint is None or other is None:
        return ImageCalibration(_deviation(first))
    weighed, deviation = prior.weigh(joint.likelihood), _deviation(other)
    share = weighed.pop(_AS_CALIBRATED)[0]
    if share > contradicted and not _is_far(deviation, camera):
        return ImageCalibration(deviation)
    best = max(weighed, key=lambda hypothesis: weighed[hypothesis][0])
    if best.lens == "none" and not best.is_turning:
        seen_as = corrected_camera(camera, other.camera[:3])
    else:
        other, seen_as = refit_camera(seen, joint, prior, best) or other, camera
        deviation = replace(_deviation(other), is_distorted=not best.is_turning)
    others = {key: (p / (1.0 - share), mean, cov) for key, (p, mean, cov) in weighed.items()}
    belief = weigh_poses(joint, others, (best, other.camera))
    found = SeenCamera(seen_as, other.cam_from_world, belief, other.camera[8:])
    if best.is_turning:
        return ImageCalibration(deviation, found)
    by_calibration = linearized_fit(seen, cam_from_world, unchanged)
    if by_calibration is None or not _is_better(other, by_calibration, camera):
        return ImageCalibration(deviation)
    shift = (other.cam_from_world @ cam_from_world.inverse()).log()
    return ImageCalibration(deviation, found, _mismatch(camera, best, deviation, shift, scale))


def _has_enough(fit: PoseFit) -> bool:
    """Return whether a calibrated image shows anything of its camera."""
    return fit.num_inliers >= 20 and not isinstance(fit.input_camera, UncalibratedCamera)


def _observe(
    search: Search, fit: PoseFit, points: PointObservations, max_error_px: float
) -> CameraObservations:
    return CameraObservations.from_pixels(
        points.points_img,
        points.points_world,
        points.covariances,
        fit.camera,
        search.config.pose.key_point_sigma_px,
        max_error_px=max_error_px,
        max_points=256 if max_error_px == math.inf else 512,
        correlated_error_share=search.correlated_error_share,
    )


def _prior(camera: Camera, may_turn: bool) -> CameraPrior:
    sides = camera.width / camera.fx, camera.height / camera.fy
    return CameraPrior.of_calibration(sides, may_turn)


def _deviation(found: JointFit) -> IntrinsicsDeviation:
    return IntrinsicsDeviation(*estimate_intrinsics(found))


def _is_far(seen: IntrinsicsDeviation, camera: Camera) -> bool:
    """Return whether focal length or principal point deviate by more than their noise and by a
    share of the focal length or image width that moves a pose."""
    num_sigmas, share = 5.0, 0.035
    scales = np.array([1.0, *np.repeat(camera.fx / camera.width, 2)])
    deviation, sigmas = np.abs(seen.deviation), np.sqrt(np.diag(seen.covariance))
    return bool(((deviation > num_sigmas * sigmas) & (scales * deviation > share)).any())


def _is_better(other: JointFit, by_calibration: JointFit, camera: Camera) -> bool:
    """Return whether another camera moves evidently more points near their pixels, or only explains
    errors of the map, such as those of points that are seen from aside."""
    min_gain, radii_px = 4.0, (1.0, 2.0)  # standard deviations of counts; in a 640 pixel image
    to_radii = 640.0 * camera.fx / max(camera.width, camera.height)
    before, after = (
        to_radii * np.linalg.norm(fit.errors, axis=1) for fit in (by_calibration, other)
    )
    counts = [(np.count_nonzero(before < px), np.count_nonzero(after < px)) for px in radii_px]
    return bool(sum((then - now) / math.sqrt(max(now, 1)) for now, then in counts) >= min_gain)


def find_ratio_doubt(search: Search) -> PoseFit | None:
    """Return the fit of the first matches if they ask for another ratio of fy to fx."""
    first, well_explained = search.retrieved, 0.85  # of the matches, by the calibration
    if not isinstance(first, PoseFit) or not _has_enough(first):
        return None
    if first.num_inliers >= well_explained * len(first.matches):
        return None
    seen = first.match_observations
    arguments = seen.points_img.astype(np.float64), seen.points_world, first.camera
    return first if is_scaled_apart(*arguments, search.config.pose) else None


def doubt_ratio(search: Search, calibrated: PoseFit, found: PoseFit) -> CalibrationMismatch:
    """Return the mismatch of a calibration with the camera of an image whose width and height were
    scaled apart. Focal lengths are fy."""
    scale, seen, stated = search.query.scale, found.camera, calibrated.camera
    return CalibrationMismatch(
        seen.fy * scale,
        0.01 * seen.fy * scale,
        stated.fy * scale,
        _principal_point(seen, scale),
        _principal_point(stated, scale),
        ["height"],
        (found.pose.cam_from_world @ calibrated.pose.cam_from_world.inverse()).log(),
    )


def find_focal_doubt(search: Search, fit: PoseFit) -> str:
    """Return a sentence if the points of a refused pose ask for another focal length, else "". Too
    few agree to say which one."""
    num_sigmas, least = 3.0, 0.15  # logarithm; right calibrations of 108 refusals: up to 0.056
    if not _has_enough(fit):
        return ""
    seen, free = _observe(search, fit, fit.inlier_observations(1.0), math.inf), _OTHER_INTRINSICS
    moments = _prior(fit.camera, False).moments(free)
    found = fit_jointly(seen, fit.pose.cam_from_world, unchanged_camera(), moments, free.basis)
    if found is None:
        return ""
    deviation, covariance = estimate_intrinsics(found)
    stretch, sigma = deviation[0], math.sqrt(covariance[0, 0])
    if abs(stretch) < max(least, num_sigmas * sigma):
        return ""
    longer = "longer" if stretch > 0.0 else "shorter"
    focal = fit.camera.fx * search.query.scale
    asked = f"the image asks for a focal length {longer} than {focal:.0f} px"
    return f"or the calibration is wrong: {asked}"


def _mismatch(
    calibrated: Camera,
    best: CameraHypothesis,
    seen: IntrinsicsDeviation,
    shift: Float[np.ndarray, " 6"],
    scale: float,
) -> CalibrationMismatch:
    """Return the mismatch of the calibration with the likeliest hypothesis."""
    is_off = not best.is_focal_stated, bool(best.off_centre), best.lens != "none"
    # the amount of distortion is not measured
    camera = calibrated if is_off[2] else corrected_camera(calibrated, seen.deviation)
    return CalibrationMismatch(
        camera.fx * scale,
        math.sqrt(seen.covariance[0, 0]) * camera.fx * scale,
        calibrated.fx * scale,
        _principal_point(camera, scale),
        _principal_point(calibrated, scale),
        list(compress(("focal_length", "principal_point", "distortion"), is_off)),
        shift,
    )


def _principal_point(camera: Camera, scale: float) -> Float[np.ndarray, " 2"]:
    """Return the principal point in an image that is `scale` times as wide."""
    return (np.array([camera.cx, camera.cy]) + 0.5) * scale - 0.5
