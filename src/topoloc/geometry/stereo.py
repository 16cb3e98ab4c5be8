"""Metric points of a rectified stereo pair or of a depth image, and how far to trust them: 3x3 covariances to first order.

Disparity is x_left - x_right of the rectified pair, in pixels, larger for nearer points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import StereoRig


@dataclass(frozen=True)
class StereoNoise:
    """Standard deviations of a key point's position (along x and along y) and of its disparity, pixels."""

    sigma_px: float = 0.7
    sigma_disparity_px: float = 0.5


@dataclass(frozen=True)
class DepthNoise:
    """Standard deviation of measured depth: ``constant + quadratic * (z - offset)^2``, metres.

    The defaults are the Kinect v1's axial noise as measured by Nguyen, Izadi and Lovell, *Modeling Kinect sensor noise for
    improved 3D reconstruction and tracking*, 2012, Eq. 2. Khoshelham and Oude Elberink (2012) derive 1.425e-3 z^2 for it.
    """

    sigma_px: float = 0.7
    constant: float = 0.0012
    quadratic: float = 0.0019
    offset: float = 0.4


def depth_from_disparity(disparity_px: Float[np.ndarray, " n"], rig: StereoRig) -> Float[np.ndarray, " n"]:
    """Depth along z in metres, ``f b / disparity``; NaN where the disparity is not that of a point in front of the rig."""
    effective = disparity_px - (rig.left.cx - rig.right.cx)
    return rig.left.fx * rig.baseline / np.where(effective > 0.0, effective, np.nan)


def disparity_from_depth(depth: Float[np.ndarray, " n"], rig: StereoRig) -> Float[np.ndarray, " n"]:
    """Disparity in pixels of depths in metres; NaN where the depth is not positive."""
    return rig.left.fx * rig.baseline / np.where(depth > 0.0, depth, np.nan) + (rig.left.cx - rig.right.cx)


def points_from_disparity(
    points_img: Float[np.ndarray, "n 2"], disparity_px: Float[np.ndarray, " n"], rig: StereoRig
) -> Float[np.ndarray, "n 3"]:
    """Points in the left camera's frame, metres, of pixels of the left image; rows of NaN where there is no depth."""
    return points_from_depth(points_img, depth_from_disparity(disparity_px, rig), rig.left)


def points_from_depth(points_img: Float[np.ndarray, "n 2"], depth: Float[np.ndarray, " n"], camera: Camera) -> Float[np.ndarray, "n 3"]:
    """Points in the camera frame, metres, of pixels and their depth along z; rows of NaN where the depth is not positive."""
    z = np.where(depth > 0.0, depth, np.nan)
    return np.column_stack([camera.normalized_from_img(points_img) * z[:, None], z])


def depth_sigmas_of_disparity(
    depth: Float[np.ndarray, " n"], sigma_disparity_px: Float[np.ndarray, " n"], rig: StereoRig
) -> Float[np.ndarray, " n"]:
    """Standard deviation (m) of stereo depth (m), to first order: ``z^2 / (f b)`` times that of the disparity."""
    return depth**2 / (rig.left.fx * rig.baseline) * sigma_disparity_px


def depth_sigmas(depth: Float[np.ndarray, " n"], noise: DepthNoise) -> Float[np.ndarray, " n"]:
    """Standard deviation (m) of measured depth (m)."""
    return noise.constant + noise.quadratic * (depth - noise.offset) ** 2


def covariances_from_disparity(
    points_cam: Float[np.ndarray, "n 3"], rig: StereoRig, noise: StereoNoise | None = None
) -> Float[np.ndarray, "n 3 3"]:
    """Covariances (m^2) of points of the left camera's frame that a rectified pair measured.

    First order, with independent errors of pixel and disparity: long ellipsoids along the ray, growing with the fourth
    power of depth (Matthies and Shafer, *Error modeling in stereo navigation*, 1987).
    """
    noise = noise or StereoNoise()
    sigma_z = depth_sigmas_of_disparity(points_cam[:, 2], np.full(len(points_cam), noise.sigma_disparity_px), rig)
    return ray_covariances(points_cam, sigma_z, rig.left, np.full(len(points_cam), noise.sigma_px))


def covariances_from_depth(
    points_cam: Float[np.ndarray, "n 3"], camera: Camera, noise: DepthNoise | None = None
) -> Float[np.ndarray, "n 3 3"]:
    """Covariances (m^2) of points of the camera frame that a depth sensor measured, to first order."""
    noise = noise or DepthNoise()
    sigma_z = depth_sigmas(points_cam[:, 2], noise)
    return ray_covariances(points_cam, sigma_z, camera, np.full(len(points_cam), noise.sigma_px))


def ray_covariances(
    points_cam: Float[np.ndarray, "n 3"], sigma_z: Float[np.ndarray, " n"], camera: Camera, sigma_px: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3 3"]:
    """Covariances (m^2) of points of the camera frame from the uncertainty of each one's depth (m) and pixel (px).

    With p = z (x, y, 1): dp/dz = p / z along the ray, and dp/d(pixel) = z d(x, y)/d(pixel) across it.
    """
    z = points_cam[:, 2:]
    ray = points_cam / z
    across = sigma_px[:, None, None] * z[:, :, None] * camera.normalized_jacobian(ray[:, :2])
    covariances = sigma_z[:, None, None] ** 2 * ray[:, :, None] * ray[:, None, :]
    covariances[:, :2, :2] += across @ across.transpose(0, 2, 1)
    return covariances
