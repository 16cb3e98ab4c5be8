"""Model a stereo rig: two calibrated cameras, the transform between them, and its rectification to
pinholes side by side."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32

from topoloc.errors import CalibrationError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3, exp_so3, log_so3
from topoloc.json_data import OneLine


def depth_from_disparity(
    disparity_px: Float[np.ndarray, " n"], rig: StereoRig
) -> Float[np.ndarray, " n"]:
    """Return the depth along z in metres, ``f b / disparity``. Disparities of no point in front of
    the rig give NaN."""
    effective = disparity_px - (rig.left.cx - rig.right.cx)
    return rig.left.fx * rig.baseline / np.where(effective > 0.0, effective, np.nan)


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


_NUM_OUTLINE_POINTS = 101
_MAX_ANGLE = np.deg2rad(60.0)


@dataclass(frozen=True, repr=False)
class StereoRig(OneLine):
    """Hold the left and right camera. `right_from_left` is in metres.

    Raises:
        CalibrationError: the baseline is zero or not finite.
    """

    left: Camera
    right: Camera
    right_from_left: Rigid3

    def __post_init__(self) -> None:
        if not np.isfinite(self.baseline) or self.baseline < 1e-6:
            raise CalibrationError(f"stereo rig: baseline of {self.baseline:g} m")

    @staticmethod
    def rectified(camera: Camera, baseline: float) -> StereoRig:
        """Return two equal pinhole cameras side by side, the right one `baseline` metres to +x."""
        return StereoRig(camera, camera, Rigid3(np.eye(3), np.array([-baseline, 0.0, 0.0])))

    @property
    def baseline(self) -> float:
        """Return the distance between the two camera centres, metres."""
        return float(np.linalg.norm(self.right_from_left.translation))

    @property
    def is_rectified(self) -> bool:
        """Return whether both cameras are undistorted with equal rows, and the right one lies
        straight to +x. Principal points may differ in x."""
        left, right, translation = self.left, self.right, self.right_from_left.translation
        return bool(
            not (left.is_distorted or right.is_distorted)
            and (left.width, left.height) == (right.width, right.height)
            and np.allclose([left.fx, left.fy, left.cy], [right.fx, right.fy, right.cy], atol=1e-6)
            and np.allclose(self.right_from_left.rotation, np.eye(3), atol=1e-9)
            and translation[0] < 0
            and np.allclose(translation[1:], 0.0, atol=1e-9)
        )


@dataclass(frozen=True, eq=False)
class Rectification:
    """Hold the maps that rectify a raw image pair: ``cv2.remap(image, left_map, None,
    cv2.INTER_LINEAR)``, and the same for right.

    `rig` is the rig of the remapped images. `rectified_from_left` is a pure rotation, so a pose of
    the left camera becomes ``world_from_rectified = world_from_left @
    rectified_from_left.inverse()``. The maps hold raw pixels (x, y).
    """

    rig: StereoRig
    rectified_from_left: Rigid3
    left_map: Float32[np.ndarray, "h w 2"]
    right_map: Float32[np.ndarray, "h w 2"]


def rectify(rig: StereoRig) -> Rectification:
    """Rectify a rig of any two camera models: equal pinhole cameras, equal rows, zero disparity at
    infinity, no black border.

    Each camera turns by half of the angle between the two. Then both turn so that the baseline
    becomes the x axis (Bouguet's method, as in OpenCV's stereoRectify). The common pinhole is the
    widest that both images fill. An already rectified rig keeps its cameras.

    Raises:
        CalibrationError: the right camera is not to the right of the left one, the sizes differ, or
            the views hardly overlap.
    """
    if (rig.left.width, rig.left.height) != (rig.right.width, rig.right.height):
        raise CalibrationError(
            f"stereo rig: left image is {rig.left.width}x{rig.left.height}, right is"
            f" {rig.right.width}x{rig.right.height}; sizes must agree"
        )
    rotation_left, rotation_right = _rectifying_rotations(rig)
    left, right = rig.left, rig.right
    if not rig.is_rectified:
        left = right = _common_pinhole(rig, rotation_left, rotation_right)
    return Rectification(
        rig=replace(StereoRig.rectified(left, rig.baseline), right=right),
        rectified_from_left=Rigid3(rotation_left, np.zeros(3)),
        left_map=_compute_remap(rig.left, left, rotation_left),
        right_map=_compute_remap(rig.right, right, rotation_right),
    )


def _rectifying_rotations(
    rig: StereoRig,
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"]]:
    """Return (rectified_from_left, rectified_from_right)."""
    half = log_so3(rig.right_from_left.rotation) / 2.0
    mid_from_left, mid_from_right = exp_so3(half), exp_so3(-half)
    right_in_mid = -(mid_from_right @ rig.right_from_left.translation)
    x, y, z = right_in_mid
    place = f"({x:.3g}, {y:.3g}, {z:.3g}) m from the left one (x right, y down, z forward)"
    shown = f"the right camera is at {place}"
    if abs(x) < max(abs(y), abs(z)):
        raise CalibrationError(f"stereo rig: not side by side: {shown}")
    if x < 0:
        raise CalibrationError(f"stereo rig: left and right look swapped: {shown}")
    direction = right_in_mid / rig.baseline
    axis = np.cross(direction, [1.0, 0.0, 0.0])
    length = float(np.linalg.norm(axis))
    turn = axis / length * np.arctan2(length, direction[0]) if length > 0.0 else np.zeros(3)
    rectified_from_mid = exp_so3(turn)
    return rectified_from_mid @ mid_from_left, rectified_from_mid @ mid_from_right


def _common_pinhole(
    rig: StereoRig,
    rotation_left: Float[np.ndarray, "3 3"],
    rotation_right: Float[np.ndarray, "3 3"],
) -> Camera:
    """Return the widest pinhole whose pixels all lie in both raw images."""
    low, high = _inner_rectangle(rig.left, rotation_left)
    low_right, high_right = _inner_rectangle(rig.right, rotation_right)
    low, high = np.maximum(low, low_right), np.minimum(high, high_right)
    size = np.array([rig.left.width, rig.left.height], dtype=np.float64)
    if not np.all(high - low > 1e-3):
        raise CalibrationError(
            "stereo rig: the views of left and right hardly overlap; the calibration looks wrong"
        )
    focal = float(np.max((size - 1.0) / (high - low)))
    cx, cy = (size - 1.0) / 2.0 - focal * (low + high) / 2.0
    return Camera.pinhole(rig.left.width, rig.left.height, focal, focal, cx, cy)


def _inner_rectangle(
    camera: Camera, rotation: Float[np.ndarray, "3 3"]
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Return the (low, high) corners of an upright rectangle inside the raw image's outline, on the
    rectified plane z = 1.

    Rays more than 60 degrees off the axis are excluded, because a pinhole would spend most of its
    pixels on them.
    """
    right, bottom = camera.width - 1.0, camera.height - 1.0
    steps = np.linspace(0.0, 1.0, _NUM_OUTLINE_POINTS)
    zeros, ones = np.zeros(_NUM_OUTLINE_POINTS), np.ones(_NUM_OUTLINE_POINTS)
    sides = []
    for x, y in ((zeros, steps), (steps, zeros), (ones, steps), (steps, ones)):
        rays = camera.rays_from_img(np.column_stack([x * right, y * bottom])) @ rotation.T
        sides.append(rays[:, :2] / np.where(rays[:, 2:] > np.cos(_MAX_ANGLE), rays[:, 2:], np.nan))
    widest = np.tan(_MAX_ANGLE)
    low = [np.nanmax(side[:, axis], initial=-widest) for axis, side in enumerate(sides[:2])]
    high = [np.nanmin(side[:, axis], initial=widest) for axis, side in enumerate(sides[2:])]
    return np.array(low), np.array(high)


def _compute_remap(
    raw: Camera, rectified: Camera, rotation: Float[np.ndarray, "3 3"]
) -> Float32[np.ndarray, "h w 2"]:
    shape = rectified.height, rectified.width
    grid = np.indices(shape, dtype=np.float64)[::-1].reshape(2, -1).T
    # Pixels without a ray get a place outside of the image, where remap fills black.
    pixels = np.nan_to_num(raw.img_from_cam(rectified.rays_from_img(grid) @ rotation), nan=-1e4)
    return pixels.reshape(*shape, 2).astype(np.float32)
