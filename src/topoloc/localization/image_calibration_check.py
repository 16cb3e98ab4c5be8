"""Check the camera against one image: its calibration, and whether it turned while its rows were
read.

A wrong calibration gives a wrong pose with a small covariance, and a camera that turned shears its
image, but the residuals of the points show such errors. One linear step asks whether they do. If
so, pose and camera are fitted together, and the likeliest hypothesis is believed
(`geometry/joint_camera/`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
from jaxtyping import Float, Float32

from topoloc.geometry.calibration_check import (
    CalibrationConsistency,
    CalibrationMismatch,
    IntrinsicsDeviation,
    check_calibration_consistency,
    corrected_camera,
)
from topoloc.geometry.camera import Camera, UncalibratedCamera
from topoloc.geometry.joint_camera.camera_hypotheses import (
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
)
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.pose_fit import PoseFit
from topoloc.localization.result import Localization, NotLocalized
from topoloc.localization.search import Search

_AS_CALIBRATED, _OTHER_INTRINSICS = CameraHypothesis(), CameraHypothesis(False, "xy")


@dataclass(frozen=True, eq=False)
class TurningCamera:
    """Hold the pose of the middle row and the rotation (radians, camera axes) from the first to the
    last row. `covariance` is what the rotation adds to that of the pose (left perturbation)."""

    cam_from_world: Rigid3
    rotation: Float[np.ndarray, " 3"]
    covariance: Float[np.ndarray, "6 6"]

    def undo(self, points_img: Float32[np.ndarray, "n 2"], camera: Camera) -> np.ndarray:
        """Return where pixels would be if all rows were read with the middle one. Pixels without a
        ray stay."""
        points_img = points_img.astype(np.float64)
        rays = np.insert(camera.normalized_from_img(points_img), 2, 1.0, axis=1)
        times = row_times(points_img, camera.height)
        moved = camera.img_from_cam(rays - times[:, None] * np.cross(self.rotation, rays))
        return np.where(np.isfinite(moved), moved, points_img).astype(np.float32)


@dataclass(frozen=True, eq=False)
class ImageCalibration:
    """Hold what an image shows of its camera: the deviation from the calibration, the mismatch if
    the image contradicts it, and the rotation if the camera turned."""

    seen: IntrinsicsDeviation | None = None
    doubt: CalibrationMismatch | None = None
    turning: TurningCamera | None = None


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
    """Compare the inliers of a fit with its calibration (`compare_with_calibration`)."""
    seen = _observe(search, fit)
    if seen is None:
        return ImageCalibration()
    found = compare_with_calibration(
        seen, fit.camera, fit.pose.cam_from_world, may_turn=may_turn, scale=search.query.scale
    )
    if found.seen is None:
        return found
    return replace(found, seen=replace(found.seen, place=fit.node_id))


def compare_with_calibration(
    seen: CameraObservations,
    camera: Camera,
    cam_from_world: Rigid3,
    *,
    may_turn: bool,
    scale: float = 1.0,
) -> ImageCalibration:
    """Compare an image with its calibration, and with a camera that turned while a rolling shutter
    read its rows, if it `may_turn`.

    The pose was found with the calibration. The original image is `scale` times as wide.
    """
    settled, contradicted = 0.9, 0.1  # probabilities of the calibration
    unchanged, joint = unchanged_camera(), None
    first = linearized_fit(seen, cam_from_world, unchanged)
    if first is None:
        return ImageCalibration()
    prior = _prior(camera, may_turn)
    if prior.weigh(first.likelihood)[_AS_CALIBRATED][0] < settled:
        joint = fit_camera(seen, cam_from_world, unchanged, prior)
    other = joint and refit_camera(seen, joint, prior, _OTHER_INTRINSICS)
    if joint is None or other is None:
        return ImageCalibration(IntrinsicsDeviation(*estimate_intrinsics(first)))
    deviation, weighed = (
        IntrinsicsDeviation(*estimate_intrinsics(other)),
        prior.weigh(joint.likelihood),
    )
    if weighed.pop(_AS_CALIBRATED)[0] > contradicted and not _is_far(deviation, camera):
        return ImageCalibration(deviation)
    best = max(weighed, key=lambda hypothesis: weighed[hypothesis][0])
    if best.is_turning or best.lens != "none":
        other = refit_camera(seen, joint, prior, best) or other
        deviation = IntrinsicsDeviation(
            *estimate_intrinsics(other), is_distorted=not best.is_turning
        )
    if best.is_turning:
        return ImageCalibration(deviation, turning=_turning(other, prior, best))
    shift = (other.cam_from_world @ cam_from_world.inverse()).log()
    return ImageCalibration(deviation, _mismatch(camera, best, deviation, shift, scale))


def _prior(camera: Camera, may_turn: bool) -> CameraPrior:
    sides = camera.width / camera.fx, camera.height / camera.fy
    return CameraPrior.of_calibration(sides, may_turn)


def _turning(found: JointFit, prior: CameraPrior, hypothesis: CameraHypothesis) -> TurningCamera:
    _, _, covariance = prior.weigh(found.likelihood)[hypothesis]
    by_turn = found.pose_by_camera[:, 8:]
    of_pose = by_turn @ covariance[8:, 8:] @ by_turn.T
    return TurningCamera(found.cam_from_world, found.camera[8:], of_pose)


def _is_far(seen: IntrinsicsDeviation, camera: Camera) -> bool:
    """Return whether focal length or principal point deviate by more than their noise and by a
    share of the focal length or image width that moves a pose."""
    num_sigmas, share = 5.0, 0.035
    scales = np.array([1.0, *np.repeat(camera.fx / camera.width, 2)])
    deviation, sigmas = np.abs(seen.deviation), np.sqrt(np.diag(seen.covariance))
    return bool(((deviation > num_sigmas * sigmas) & (scales * deviation > share)).any())


def find_focal_doubt(search: Search, fit: PoseFit) -> str:
    """Return a sentence if the points of a refused pose ask for another focal length, else "". Too
    few agree to say which one."""
    num_sigmas, least = 3.0, 0.15  # logarithm; right calibrations of 108 refusals: up to 0.056
    seen, free = _observe(search, fit), _OTHER_INTRINSICS
    if seen is None:
        return ""
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


def _observe(search: Search, fit: PoseFit) -> CameraObservations | None:
    """Return inliers of a calibrated image, None if they are too few."""
    min_points, max_points = 20, 256
    inliers = fit.inlier_observations(1.0)
    if isinstance(fit.input_camera, UncalibratedCamera) or len(inliers) < min_points:
        return None
    return CameraObservations.from_pixels(
        inliers.points_img,
        inliers.points_world,
        inliers.covariances,
        fit.camera,
        search.config.pose.key_point_sigma_px,
        max_points=max_points,
        correlated_error_share=search.correlated_error_share,
    )


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
