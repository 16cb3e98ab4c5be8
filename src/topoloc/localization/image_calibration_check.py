"""Check the camera calibration against one image, and penalize the result if they contradict.

A wrong focal length or principal point gives a wrong pose with a small covariance. The residuals of
the points show the error (`geometry/calibration_check.py`). If they do, the points are matched
again around the corrected pose and camera until the estimate converges. The reported camera is then
the image's own, not one halfway.

The corrected camera must explain the image better than the calibration does. If the map itself is
inaccurate, as in a bend that was seen from one lane only, another camera fits no better.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from itertools import compress

import numpy as np
from jaxtyping import Float

from topoloc.geometry.calibration_check import (
    CalibrationConsistency,
    ImageCalibration,
    check_calibration_consistency,
    compute_intrinsics_deviation,
    corrected_camera,
    estimate_image_calibration,
)
from topoloc.geometry.calibration_mismatch import CalibrationMismatch, IntrinsicsDeviation
from topoloc.geometry.camera import Camera, UncalibratedCamera
from topoloc.geometry.joint_camera.camera_hypotheses import (
    CameraPrior,
    Vector,
    map_variance,
    unchanged_camera,
)
from topoloc.geometry.joint_camera.joint_fit import (
    CameraObservations,
    JointFit,
    fit_camera,
    linearized_fit,
    weigh_cameras,
)
from topoloc.geometry.pose_matches import cells_of
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.guided import match_guided
from topoloc.localization.pose_fit import PointMatches, PoseFit, fit_pose
from topoloc.localization.result import Localization, NotLocalized
from topoloc.localization.search import Search


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


def check_image_calibration(
    search: Search, fit: PoseFit
) -> tuple[IntrinsicsDeviation | None, CalibrationMismatch | None]:
    """Estimate the camera from the inliers of a fit and compare it with the calibration.

    Returns:
        The deviation from the calibration, None if it cannot be estimated or there is no
        calibration. The mismatch, None if the two agree.
    """
    suspect, reported = (3.0, 0.01), (5.0, 0.035)  # sigmas, share of focal length or image width
    if isinstance(fit.input_camera, UncalibratedCamera):
        return None, None
    mismatch, found = _check_distortion(search, fit), _estimate_image_calibration(search, fit)
    if found is None:
        return None, mismatch
    if mismatch is not None:
        seen = compute_intrinsics_deviation(fit.camera, fit.camera, found, fit.node_id)
        return replace(seen, is_distorted=True), mismatch
    if not any(_is_calibration_off(fit, found, fit.camera, *suspect)):
        return compute_intrinsics_deviation(fit.camera, fit.camera, found, fit.node_id), None
    by_calibration, calibrated, first, place = fit, fit.camera, fit.cam_from_world, fit.node_id
    fit, found = _refine_image_calibration(search, fit, found)
    seen = compute_intrinsics_deviation(calibrated, fit.camera, found, place)
    is_off = _is_calibration_off(fit, found, calibrated, *reported)
    if not any(is_off) or not _is_better(_gain(by_calibration, fit)):
        return seen, None
    camera, scale = corrected_camera(fit.camera, found), search.query.scale
    return seen, CalibrationMismatch(
        camera.fx * scale,
        math.sqrt(found.covariance[0, 0]) * camera.fx * scale,
        calibrated.fx * scale,
        _principal_point(camera, scale),
        _principal_point(calibrated, scale),
        list(compress(("focal_length", "principal_point"), is_off)),
        (found.cam_from_world @ first.inverse()).log(),
    )


def find_focal_doubt(search: Search, fit: PoseFit) -> str:
    """Return a sentence if the points of a refused pose ask for another focal length, else "".

    Too few agree to say which one. It is by one linear step, less than a millisecond."""
    num_sigmas, least = 3.0, 0.15  # logarithm; right calibrations of 108 refusals: up to 0.056
    is_calibrated = not isinstance(fit.input_camera, UncalibratedCamera)
    found = _estimate_image_calibration(search, fit) if is_calibrated else None
    if found is None:
        return ""
    stretch, sigma = math.log(found.scale), math.sqrt(found.covariance[0, 0])
    if abs(stretch) < max(least, num_sigmas * sigma):
        return ""
    longer = "longer" if stretch > 0.0 else "shorter"
    focal = fit.camera.fx * search.query.scale
    asked = f"the image asks for a focal length {longer} than {focal:.0f} px"
    return f"or the calibration is wrong: {asked}"


def _check_distortion(search: Search, fit: PoseFit) -> CalibrationMismatch | None:
    """Return the mismatch if the residuals show distortion that the calibration leaves out.

    A linear estimate is enough where they show none. It gives distortion that is there a small
    probability, but less than this threshold in none of 300 images through two lenses, and in 87 %
    of 150 images without (`benchmarks/inputs.py`, six places).
    """
    seen, camera = fit.inlier_observations(1.0), fit.camera
    seen = seen.select(np.unique(np.linspace(0, len(seen) - 1, 256).astype(int)))
    points_img = seen.points_img.astype(np.float64)
    observed = CameraObservations(
        camera.normalized_from_img(points_img),
        search.config.pose.key_point_sigma_px / camera.fx,
        seen.points_world,
        seen.covariances,
        cells_of(points_img, camera.width, camera.height),
        math.inf,
    )
    sides = camera.width / camera.fx, camera.height / camera.fy
    calibrated = unchanged_camera()
    # standard deviations of the logarithm of the focal length: calibrated or not
    prior = CameraPrior(sides, stated=(0.0, 0.01), usual=(0.0, 0.3))
    joint = linearized_fit(observed, fit.cam_from_world, calibrated)
    if joint is None or _find_distortion(joint, prior, 0.012) is None:
        return None
    joint = fit_camera(observed, fit.cam_from_world, calibrated, prior)
    if joint is not None:
        shared = map_variance(search.correlated_error_share)
        joint = replace(joint, variance=shared * joint.variance)
    found = None if joint is None else _find_distortion(joint, prior, 0.99)
    if joint is None or found is None:
        return None
    before_px, after_px = (
        camera.fx * np.linalg.norm(observed.linearize(pose, parameters)[2], axis=1)
        for pose, parameters in (
            (fit.cam_from_world, calibrated),
            (joint.cam_from_world, joint.camera),
        )
    )
    if not _is_better(_gain_of(before_px, after_px, max(camera.width, camera.height))):
        return None
    scale = search.query.scale
    focal, centre = camera.fx * scale, _principal_point(camera, scale)
    # from the pose under the calibration to the pose under the estimated camera
    cam_from_world = (
        Rigid3.exp(joint.pose_by_camera @ (found - joint.camera)) @ joint.cam_from_world
    )
    shift = (cam_from_world @ fit.cam_from_world.inverse()).log()
    return CalibrationMismatch(focal, 0.0, focal, centre, centre, ["distortion"], shift)


def _find_distortion(joint: JointFit, prior: CameraPrior, min_probability: float) -> Vector | None:
    """Return the likeliest camera parameters, None unless distortion is probable."""
    weighed = weigh_cameras(joint.likelihood, prior)
    if sum(weighed[one][0] for one in weighed if one.lens != "none") < min_probability:
        return None
    return max(weighed.values(), key=lambda one: one[0])[1]


def _refine_image_calibration(
    search: Search, fit: PoseFit, found: ImageCalibration
) -> tuple[PoseFit, ImageCalibration]:
    """Match the points again around the estimated camera until the estimate converges.

    It does nothing if `guided.num_nodes` is 0.
    """
    num_rounds, converged_change = 4, 0.003
    for _ in range(num_rounds if search.config.guided.num_nodes else 0):
        around = _rematch(search, fit, found)
        if not isinstance(around, PoseFit):
            break
        again = _estimate_image_calibration(search, around)
        if again is None:  # no estimate: keep the previous one
            break
        fit, found = around, again
        if max(abs(math.log(found.scale)), float(np.abs(found.offset).max())) < converged_change:
            break
    return fit, found


def _gain(before: PoseFit, after: PoseFit) -> float:
    """Return `_gain_of` for the inliers of two fits."""
    before_px, after_px = (
        fit.inlier_observations(1.0).errors_px(fit.camera, fit.cam_from_world)
        for fit in (before, after)
    )
    return _gain_of(before_px, after_px, max(before.camera.width, before.camera.height))


def _is_better(gain: float) -> bool:
    """Return whether an image's own camera explains it better than the calibration."""
    return gain >= 3.0  # standard deviations


def _gain_of(
    before_px: Float[np.ndarray, " n"], after_px: Float[np.ndarray, " m"], side_px: int
) -> float:
    """Return the gain in points near their projections, in standard deviations of the counts.

    It is summed over two radii. `side_px` is the longer side of the image.
    """
    radii_px = 1.0, 2.0  # in an image of 640 pixels
    counts = [
        [int(np.count_nonzero(errors < px * side_px / 640.0)) for errors in (before_px, after_px)]
        for px in radii_px
    ]
    return sum((then - now) / math.sqrt(max(now, 1)) for now, then in counts)


def _estimate_image_calibration(search: Search, fit: PoseFit) -> ImageCalibration | None:
    seen = fit.inlier_observations(1.0)
    points_img, sigma_px = seen.points_img.astype(np.float64), search.config.pose.key_point_sigma_px
    found = estimate_image_calibration(
        points_img, seen.points_world, seen.covariances, fit.camera, fit.cam_from_world, sigma_px
    )
    if found is None:
        return None
    return replace(found, covariance=map_variance(search.correlated_error_share) * found.covariance)


def _rematch(search: Search, fit: PoseFit, found: ImageCalibration) -> PointMatches:
    """Match the points again around the estimated pose and camera."""
    camera, cam_from_world = corrected_camera(fit.camera, found), found.cam_from_world
    config = search.config
    rows = search.map.nearest(cam_from_world.inverse(), config.guided.num_nodes)
    local_map = search.map.local_map(rows)
    matches = match_guided(fit.features, local_map, cam_from_world, camera, config.guided)
    return fit_pose(fit.features, camera, local_map, matches, config.pose, (cam_from_world, camera))


def _is_calibration_off(
    fit: PoseFit, found: ImageCalibration, calibrated: Camera, num_sigmas: float, share: float
) -> tuple[bool, bool]:
    """Return whether the focal length and the principal point are off.

    Both `num_sigmas` and `share` must be exceeded. `share` refers to the focal length and the image
    width.
    """
    camera, sigmas = corrected_camera(fit.camera, found), np.sqrt(np.diag(found.covariance))
    stretch = abs(math.log(camera.fx / calibrated.fx))
    offset = np.abs(_principal_point(camera, 1.0) - _principal_point(calibrated, 1.0))
    is_far = (offset > num_sigmas * sigmas[1:] * calibrated.fx) & (
        offset > share * calibrated.width
    )
    return bool(stretch > num_sigmas * sigmas[0] and stretch > share), bool(is_far.any())


def _principal_point(camera: Camera, scale: float) -> Float[np.ndarray, " 2"]:
    """Return the principal point in an image that is `scale` times as wide."""
    return (np.array([camera.cx, camera.cy]) + 0.5) * scale - 0.5
