"""Compute metric points from a rectified stereo pair or a depth image, with 3x3 covariances to
first order.

Disparity is x_left - x_right of the rectified pair, in pixels, larger for nearer points.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import StereoRig


def depth_from_disparity(
    disparity_px: Float[np.ndarray, " n"], rig: StereoRig
) -> Float[np.ndarray, " n"]:
    """Return the depth along z in metres, ``f b / disparity``. Disparities of no point in front of
    the rig give NaN."""
    effective = disparity_px - (rig.left.cx - rig.right.cx)
    return rig.left.fx * rig.baseline / np.where(effective > 0.0, effective, np.nan)


def points_from_disparity(
    points_img: Float[np.ndarray, "n 2"], disparity_px: Float[np.ndarray, " n"], rig: StereoRig
) -> Float[np.ndarray, "n 3"]:
    """Return points in the left camera's frame (metres) from pixels of the left image and their
    disparity. Rows without a depth are NaN."""
    return points_from_depth(points_img, depth_from_disparity(disparity_px, rig), rig.left)


def points_from_depth(
    points_img: Float[np.ndarray, "n 2"], depth: Float[np.ndarray, " n"], camera: Camera
) -> Float[np.ndarray, "n 3"]:
    """Return points in the camera frame (metres) from pixels and their depth along z. Rows without
    a positive depth are NaN."""
    z = np.where(depth > 0.0, depth, np.nan)
    return np.column_stack([camera.normalized_from_img(points_img) * z[:, None], z])


def depth_sigmas_of_disparity(
    depth: Float[np.ndarray, " n"], sigma_disparity_px: Float[np.ndarray, " n"], rig: StereoRig
) -> Float[np.ndarray, " n"]:
    """Return the standard deviation (m) of stereo depth (m), to first order: ``z^2 / (f b)`` times
    that of the disparity."""
    return depth**2 / (rig.left.fx * rig.baseline) * sigma_disparity_px


def depth_sigmas(depth: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the standard deviation (m) of measured depth (m): ``0.0012 + 0.0019 (z - 0.4)^2``.

    This is the Kinect v1's axial noise in Nguyen, Izadi and Lovell, *Modeling Kinect sensor noise
    for improved 3D reconstruction and tracking*, 2012, Eq. 2. Khoshelham and Oude Elberink (2012)
    derive 1.425e-3 z^2 for it.
    """
    return 0.0012 + 0.0019 * (depth - 0.4) ** 2


def ray_covariances(
    points_cam: Float[np.ndarray, "n 3"],
    sigma_z: Float[np.ndarray, " n"],
    camera: Camera,
    sigma_px: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n 3 3"]:
    """Return the covariances (m^2) of points in the camera frame from the uncertainty of their
    depth (m) and pixel (px).

    First order: with p = z (x, y, 1), dp/dz = p / z along the ray, and dp/d(pixel) = z d(x,
    y)/d(pixel) across it. For a rectified pair these are long ellipsoids that grow with the fourth
    power of depth (Matthies and Shafer, *Error modeling in stereo navigation*, 1987).
    """
    z = points_cam[:, 2:]
    ray = points_cam / z
    across = sigma_px[:, None, None] * z[:, :, None] * camera.normalized_jacobian(ray[:, :2])
    covariances = sigma_z[:, None, None] ** 2 * ray[:, :, None] * ray[:, None, :]
    covariances[:, :2, :2] += across @ across.transpose(0, 2, 1)
    return covariances
