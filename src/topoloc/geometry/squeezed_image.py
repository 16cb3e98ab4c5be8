"""Estimate pose and camera of an image whose width and height may have been scaled apart, as some
clients do before they send it: then fy is not fx.

Rows are stretched back by a ratio, and the pose is that of an ordinary camera. Only matches before
any guiding tell the ratio: guided ones are those that fit the pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from topoloc.geometry.absolute_pose import AbsolutePose, AbsolutePoseConfig
from topoloc.geometry.absolute_pose_focal import estimate_pose_and_focal
from topoloc.geometry.camera import Camera, UncalibratedCamera
from topoloc.geometry.pose_sampling import sample_absolute_pose
from topoloc.geometry.rigid import Rigid3

_MIN_INLIERS, _WELL_EXPLAINED = 12, 0.98  # of the matches by square pixels: no ratio is searched
_STEPS = (0.09, 0.03, 0.01)  # of the logarithm of the ratio
_MAX_LOG_RATIO = 0.45
_MIN_GAIN = 0.9  # of the errors; those of whole images fall less
_TRIED_LOG_RATIO, _MIN_SIGMAS = 0.12, 3.0  # of the number of matches that another ratio explains
_Found = tuple[AbsolutePose, Camera]


@dataclass(frozen=True, eq=False)
class _Matches:
    """Hold n matches of an image, and how its pose is estimated."""

    points_img: Float[np.ndarray, "n 2"]
    points_world: Float[np.ndarray, "n 3"]
    covariances: Float[np.ndarray, "n 3 3"]
    camera: UncalibratedCamera
    config: AbsolutePoseConfig
    correlated_error_share: float

    def fit(self, log_ratio: float, start: tuple[Rigid3, Camera] | None = None) -> _Found | None:
        """Return the pose and the camera of the image with rows stretched back, whose pixels are
        squares."""
        ratio, whole = math.exp(log_ratio), self.camera
        height = max(1, round(whole.height / ratio))
        return estimate_pose_and_focal(
            (self.points_img + 0.5) / [1.0, ratio] - 0.5,
            self.points_world,
            UncalibratedCamera(whole.width, height, whole.min_focal, whole.max_focal),
            self.config,
            point_covariances=self.covariances,
            start=start,
            correlated_error_share=self.correlated_error_share,
        )

    def cost(self, log_ratio: float, found: _Found | None) -> float:
        """Return the mean squared error of all matches over the squared threshold, each at most
        1."""
        if found is None:
            return 1.0
        pixels = found[1].img_from_cam(found[0].cam_from_world.apply(self.points_world))
        stretched = (self.points_img + 0.5) / [1.0, math.exp(log_ratio)] - 0.5
        errors = np.linalg.norm(pixels - stretched, axis=1) / self.config.max_reprojection_error_px
        return float(np.mean(np.minimum(np.nan_to_num(errors, nan=1.0), 1.0) ** 2))

    def with_ratio_error(self, log_ratio: float, found: _Found) -> _Found:
        """Return the pose whose covariance includes a ratio that is off by the last step."""
        pose, camera = found
        other = self.fit(log_ratio + _STEPS[-1], (pose.cam_from_world, camera))
        if other is None or pose.camera is None:
            return found
        shift = (other[0].cam_from_world @ pose.cam_from_world.inverse()).log()
        added = np.outer(shift, shift)
        weighed = [replace(one, covariance=one.covariance + added) for one in pose.camera.weighed]
        belief = replace(pose.camera, weighed=weighed)
        return replace(pose, covariance=pose.covariance + added, camera=belief), camera


def estimate_pose_and_camera(
    points_img: Float[np.ndarray, "n 2"],
    points_world: Float[np.ndarray, "n 3"],
    uncalibrated: UncalibratedCamera,
    config: AbsolutePoseConfig,
    *,
    point_covariances: Float[np.ndarray, "n 3 3"],
    start: tuple[Rigid3, Camera] | None = None,
    correlated_error_share: float = 0.0,
) -> _Found | None:
    """Do as `estimate_pose_and_focal`, with the ratio of the focal lengths of `start`, or one that
    is searched if square pixels explain few of the matches."""
    data = points_img, points_world, point_covariances
    matches = _Matches(*data, uncalibrated, config, correlated_error_share)
    if start is not None:
        log_ratio = math.log(start[1].fy / start[1].fx)
        if abs(log_ratio) < 1e-6:
            return matches.fit(0.0, start)
        found = matches.fit(log_ratio, (start[0], _unsqueezed(start[1])))
        if found is None:
            return None
        return _squeezed(matches.with_ratio_error(log_ratio, found), log_ratio, uncalibrated)
    found = matches.fit(0.0)
    if found is None or not _MIN_INLIERS <= np.count_nonzero(found[0].inliers) < (
        _WELL_EXPLAINED * len(points_img)
    ):
        return found
    log_ratio, better = _search_ratio(matches, found)
    if better is None:
        return found
    return _squeezed(matches.with_ratio_error(log_ratio, better), log_ratio, uncalibrated)


def is_scaled_apart(
    points_img: Float[np.ndarray, "n 2"],
    points_world: Float[np.ndarray, "n 3"],
    camera: Camera,
    config: AbsolutePoseConfig,
) -> bool:
    """Return whether a calibrated image had its width and height scaled apart: another ratio of fy
    to fx explains evidently more of n matches, which were not guided by a pose."""
    pixels = camera.normalized_from_img(points_img) * [camera.fx, camera.fy]  # with any lens
    has_ray = np.isfinite(pixels).all(axis=1)
    pixels, points_world = pixels[has_ray], points_world[has_ray]

    def count(log_ratio: float) -> int:
        sizes = camera.width, camera.height, camera.fx, camera.fy * math.exp(log_ratio), 0.0, 0.0
        plain, sampling = Camera.pinhole(*sizes), config.sampling()
        found = sample_absolute_pose(pixels, points_world, plain, sampling)
        return 0 if found is None else found[1]

    square, (narrow, wide) = count(0.0), [count(sign * _TRIED_LOG_RATIO) for sign in (-1.0, 1.0)]
    best = max(narrow, wide)
    if best > square:
        best = max(best, count(2.0 * (_TRIED_LOG_RATIO if wide > narrow else -_TRIED_LOG_RATIO)))
    return best - square > _MIN_SIGMAS * math.sqrt(max(square, _MIN_INLIERS))


def _search_ratio(matches: _Matches, whole: _Found) -> tuple[float, _Found | None]:
    """Return the ratio with the smallest errors and its pose, None if square pixels do as well."""
    at, best, cost = 0.0, whole, matches.cost(0.0, whole)
    least = _MIN_GAIN * cost
    for step in _STEPS:
        direction = 0.0
        while True:
            tried = [at + step, at - step] if direction == 0.0 else [at + direction]
            found = [
                (matches.cost(one, fit), one, fit)
                for one in tried
                if abs(one) < _MAX_LOG_RATIO and (fit := matches.fit(one)) is not None
            ]
            now = min(found, key=lambda each: each[0], default=(1.0, at, best))
            if now[0] >= cost:
                break
            direction, (cost, at, best) = now[1] - at, now
        if at == 0.0:
            break
    belief = best[0].camera
    # a panorama looks squeezed as well, but only with a lens
    is_plain = belief is not None and belief.reported.lens == "none" and not belief.is_contradicted
    return (at, best) if is_plain and cost < least else (0.0, None)


def _unsqueezed(camera: Camera) -> Camera:
    ratio = camera.fy / camera.fx
    height, cy = max(1, round(camera.height / ratio)), (camera.cy + 0.5) / ratio - 0.5
    if camera.model == "PINHOLE":
        return Camera.pinhole(camera.width, height, camera.fx, camera.fx, camera.cx, cy)
    k1, k2 = camera.params[4:6]
    return Camera("RADIAL", camera.width, height, (camera.fx, camera.cx, cy, k1, k2))


def _squeezed(found: _Found, log_ratio: float, image: UncalibratedCamera) -> _Found:
    """Return the pose with the camera of the image as it is."""
    pose, c = found
    ratio = math.exp(log_ratio)
    fy, cy = c.fy * ratio, (c.cy + 0.5) * ratio - 0.5
    if c.model == "PINHOLE":
        values, model = (c.fx, fy, c.cx, cy), "PINHOLE"
    else:
        values, model = (c.fx, fy, c.cx, cy, *c.params[3:5], 0.0, 0.0), "OPENCV"
    return pose, Camera(model, image.width, image.height, values, mask=image.mask)
