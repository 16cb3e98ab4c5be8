"""A calibration that the picture contradicts: named, and paid for by the answer's covariance and
probability.

A wrong focal length or principal point gives a pose that is wrong, and as sure as any. What is left
of the points' errors shows it (`geometry/calibration_check.py`); where it does, the points are
sought once more around the pose and the camera that it leads to, until nothing changes, so that the
camera named is the picture's own and not half way there. It must explain the picture better than
the calibration does: where the map itself is off, as at a bend that was seen from one lane alone,
another camera fits no worse, and no better.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

from topoloc.geometry.calibration_check import (
    CalibrationMismatch,
    ImageCalibration,
    IntrinsicsDeviation,
    compute_intrinsics_deviation,
    corrected_camera,
    estimate_image_calibration,
)
from topoloc.geometry.calibration_consistency import (
    CalibrationConsistency,
    check_calibration_consistency,
)
from topoloc.geometry.camera import Camera
from topoloc.geometry.uncalibrated_camera import UncalibratedCamera
from topoloc.localization.guided import match_guided
from topoloc.localization.map_facts.correlated_errors import covariance_inflation
from topoloc.localization.pose_fit import PoseFit, fit_pose
from topoloc.localization.result import Localization, NotLocalized
from topoloc.localization.search import Search

_SUSPECT_LIMITS, _REPORTED_LIMITS = (
    (3.0, 0.01),
    (5.0, 0.035),
)  # sigmas, and share of the focal length or of the picture's width
_ROUNDS, _CONVERGED_CHANGE = 4, 0.003
_INLIER_RADII_PX, _LEAST_GAIN = (
    (1.0, 2.0),
    3.0,
)  # of a picture of 640 pixels; standard deviations by which points so near become more, in all


def check_camera_calibrations(
    results: Iterable[Localization | NotLocalized],
) -> list[CalibrationConsistency]:
    """What the pictures of each camera say of it together; nothing of cameras that too few pictures
    say anything of."""
    by_camera: dict[Camera, dict[IntrinsicsDeviation, None]] = {}
    for result in results:
        if result.seen_camera is not None and result.provenance.camera is not None:
            by_camera.setdefault(result.provenance.camera, {})[result.seen_camera] = (
                None  # a picture that comes twice says it once
            )
    verdicts = (
        check_calibration_consistency(list(seen), camera) for camera, seen in by_camera.items()
    )
    return [verdict for verdict in verdicts if verdict is not None]


def check_image_calibration(
    search: Search, fit: PoseFit
) -> tuple[IntrinsicsDeviation | None, CalibrationMismatch | None]:
    """What the points of an answer say of its camera (None: nothing, or there was no calibration),
    and what of that is said against the calibration (None where they agree)."""
    if isinstance(fit.input_camera, UncalibratedCamera) or fit.pose is None:
        return None, None
    found = _estimate_image_calibration(search, fit)
    if found is None:
        return None, None
    if not any(_is_calibration_off(fit, found, fit.camera, *_SUSPECT_LIMITS)):
        return compute_intrinsics_deviation(fit.camera, fit.camera, found, fit.node_id), None
    by_calibration, calibrated, first, place = fit, fit.camera, fit.pose.cam_from_world, fit.node_id
    fit, found = _refine_image_calibration(search, fit, found)
    seen = compute_intrinsics_deviation(calibrated, fit.camera, found, place)
    has_focal_mismatch, has_principal_point_mismatch = _is_calibration_off(
        fit, found, calibrated, *_REPORTED_LIMITS
    )
    if (
        not (has_focal_mismatch or has_principal_point_mismatch)
        or _gain(by_calibration, fit) < _LEAST_GAIN
    ):
        return seen, None
    camera, scale = corrected_camera(fit.camera, found), search.query.scale
    sigma = math.sqrt(
        covariance_inflation(fit.num_inliers, search.correlated_error_share)
        * found.covariance[0, 0]
    )
    return seen, CalibrationMismatch(
        camera.fx * scale,
        sigma * camera.fx * scale,
        calibrated.fx * scale,
        _principal_point(camera, scale),
        _principal_point(calibrated, scale),
        has_focal_mismatch,
        has_principal_point_mismatch,
        (found.cam_from_world @ first.inverse()).log(),
    )


def _refine_image_calibration(
    search: Search, fit: PoseFit, found: ImageCalibration
) -> tuple[PoseFit, ImageCalibration]:
    """The points sought again around what is found, until nothing changes; not at all where the
    settings seek none around poses."""
    for _ in range(_ROUNDS if search.config.guided.num_nodes else 0):
        around = _rematch(search, fit, found)
        again = _estimate_image_calibration(search, around)
        if again is None:  # it leads nowhere: what was seen at first has to do
            break
        fit, found = around, again
        if max(abs(math.log(found.scale)), float(np.abs(found.offset).max())) < _CONVERGED_CHANGE:
            break
    return fit, found


def _gain(before: PoseFit, after: PoseFit) -> float:
    """By how many more points lie where they must be seen, in standard deviations of their numbers,
    summed over how near that is."""
    counts = [
        (_count_within_radius(before, px), _count_within_radius(after, px))
        for px in _INLIER_RADII_PX
    ]
    return sum((then - now) / math.sqrt(max(now, 1)) for now, then in counts)


def _count_within_radius(fit: PoseFit, px: float) -> int:
    """How many of the fit's points are seen within so many pixels, in a picture whose longer side
    is 640, of where they must be."""
    assert fit.pose is not None
    seen = fit.inlier_observations(1.0)
    offsets = (
        fit.camera.img_from_cam(fit.pose.cam_from_world.apply(seen.points_world)) - seen.points_img
    )
    return int(
        np.count_nonzero(
            np.linalg.norm(offsets, axis=1) < px * max(fit.camera.width, fit.camera.height) / 640.0
        )
    )


def _estimate_image_calibration(search: Search, fit: PoseFit) -> ImageCalibration | None:
    if fit.pose is None:
        return None
    seen = fit.inlier_observations(1.0)
    points_img, sigma_px = seen.points_img.astype(np.float64), search.config.pose.key_point_sigma_px
    return estimate_image_calibration(
        points_img,
        seen.points_world,
        seen.covariances,
        fit.camera,
        fit.pose.cam_from_world,
        sigma_px,
    )


def _rematch(search: Search, fit: PoseFit, found: ImageCalibration) -> PoseFit:
    """The points sought again around the pose and the camera that the picture led to."""
    camera, cam_from_world, config = (
        corrected_camera(fit.camera, found),
        found.cam_from_world,
        search.config,
    )
    local_map = search.map.local_map(
        search.map.nearest(cam_from_world.inverse(), config.guided.num_nodes)
    )
    matches = match_guided(fit.features, local_map, cam_from_world, camera, config.guided)
    return fit_pose(fit.features, camera, local_map, matches, config.pose, (cam_from_world, camera))


def _is_calibration_off(
    fit: PoseFit, found: ImageCalibration, calibrated: Camera, num_sigmas: float, share: float
) -> tuple[bool, bool]:
    """Are the focal length and the principal point off by more than so many sigmas, and that share
    (of itself, of the width)?"""
    camera = corrected_camera(fit.camera, found)
    sigmas = np.sqrt(np.diag(found.covariance))
    stretch = abs(math.log(camera.fx / calibrated.fx))
    offset = np.abs(_principal_point(camera, 1.0) - _principal_point(calibrated, 1.0))
    is_far = (offset > num_sigmas * sigmas[1:] * calibrated.fx) & (
        offset > share * calibrated.width
    )
    return bool(stretch > num_sigmas * sigmas[0] and stretch > share), bool(is_far.any())


def _principal_point(camera: Camera, scale: float) -> Float[np.ndarray, " 2"]:
    """The principal point in a picture that is `scale` times as wide."""
    return (np.array([camera.cx, camera.cy]) + 0.5) * scale - 0.5
