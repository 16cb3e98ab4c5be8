"""Rain before the camera: drops that fall while the shutter is open, each at a place in space, and
drops on the lens.

A falling drop shows the light of a wide cone of the scene, mostly sky, smeared over its path (Garg
and Nayar, *Vision and Rain*, IJCV 2007): bright before dark walls, hardly seen before the sky. Both
cameras of a rig see the same drops.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3

_NEAR, _FAR = 0.4, 9.0
_FALL_SPEED = (5.0, 9.0)
_RADIUS = (0.7e-3, 1.8e-3)
_LONGEST = 0.012
"""Seconds after which a streak is so thin that a longer one adds nothing."""
_CONTRAST = 0.8
_FOCUS = 6.0
_APERTURE = 1.2e-3


@dataclass(frozen=True, eq=False)
class Drops:
    """Falling drops in the frame of the left camera: `position` (m) when the shutter opens,
    `velocity` (m/s), `radius` (m)."""

    position: Float64[np.ndarray, "n 3"]
    velocity: Float64[np.ndarray, "n 3"]
    radius: Float64[np.ndarray, " n"]


def falling_drops(
    num: int,
    camera: Camera,
    world_from_cam: Rigid3,
    camera_velocity: Float64[np.ndarray, "3"],
    rng: np.random.Generator,
) -> Drops:
    """Drops spread evenly over the air before the camera, `num` of them in its view.

    Args:
        camera_velocity: in the world, m/s; a moving camera sees the rain come towards it.
    """
    inverse_far, inverse_near = 1.0 / _FAR, 1.0 / _NEAR
    # Evenly in the volume would put all but a few far off, where they are one grey veil (the haze);
    # evenly in 1/z^(1/2) shows both.
    z = rng.uniform(inverse_far**0.5, inverse_near**0.5, num) ** -2.0
    corner = camera.normalized_from_img(
        np.array([[-0.5, -0.5], [camera.width - 0.5, camera.height - 0.5]])
    )
    x, y = (rng.uniform(corner[0, axis], corner[1, axis], num) * z for axis in (0, 1))
    fall = np.zeros((num, 3))
    fall[:, 2] = -rng.uniform(*_FALL_SPEED, num)
    fall[:, :2] = rng.normal(0.0, 0.3, (num, 2)) + rng.normal(0.0, 0.5, 2)
    velocity = (fall - camera_velocity) @ world_from_cam.rotation
    return Drops(np.column_stack([x, y, z]), velocity, rng.uniform(*_RADIUS, num))


def draw_rain(
    radiance: Float32[np.ndarray, "h w 3"],
    depth: Float32[np.ndarray, "h w"],
    camera: Camera,
    cam_from_left: Rigid3,
    drops: Drops,
    exposure_time: float,
) -> Float32[np.ndarray, "h w 3"]:
    """Add drops to the light if they are nearer than the surface behind them. Near drops are thick
    and out of focus."""
    rainy = radiance.copy()
    time = min(exposure_time, _LONGEST)
    start = cam_from_left.apply(drops.position)
    end = cam_from_left.apply(drops.position + drops.velocity * time)
    glow = radiance[: max(len(radiance) // 2, 1)].reshape(-1, 3).mean(axis=0)
    heads, tails = camera.img_from_cam(start), camera.img_from_cam(end)
    for i in np.flatnonzero(np.isfinite(heads).all(axis=1) & np.isfinite(tails).all(axis=1)):
        z = float(start[i, 2])
        blur = camera.fx * _APERTURE * abs(1.0 / z - 1.0 / _FOCUS)
        thickness = float(np.hypot(camera.fx * drops.radius[i] / z, blur))
        sigma = max(thickness, 0.45)
        share = _CONTRAST * camera.fx * drops.radius[i] / z / sigma
        share *= (
            min(2.0 * drops.radius[i] / max(np.linalg.norm(drops.velocity[i]) * time, 1e-6), 1.0)
            ** 0.5
        )
        _draw_streak(rainy, depth, heads[i], tails[i], z, sigma, min(float(share), 1.0), glow)
    return rainy


def draw_lens_drops(
    radiance: Float32[np.ndarray, "h w 3"], num: int, rng: np.random.Generator
) -> Float32[np.ndarray, "h w 3"]:
    """The light through a lens with `num` drops on it, each a soft blot that shows the surroundings
    upside down."""
    height, width = radiance.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    wet = radiance.copy()
    through = cv2.GaussianBlur(radiance[::-1, ::-1].copy(), (0, 0), width / 40.0)
    for _ in range(num):
        centre = rng.uniform([0.0, 0.0], [width, height])
        radius, stretch = width * rng.uniform(0.015, 0.045), rng.uniform(0.8, 1.25)
        distance = np.hypot((x - centre[0]) * stretch, (y - centre[1]) / stretch) / radius
        mask = (0.85 / (1.0 + np.exp((distance - 1.0) * 7.0))).astype(np.float32)[:, :, None]
        wet = wet * (1.0 - mask) + through * mask
    return wet


def _draw_streak(
    image: Float32[np.ndarray, "h w 3"],
    depth: Float32[np.ndarray, "h w"],
    head: Float64[np.ndarray, "2"],
    tail: Float64[np.ndarray, "2"],
    z: float,
    sigma: float,
    share: float,
    glow: Float32[np.ndarray, "3"],
) -> None:
    """Replace this share of the light along a line by `glow`, with a Gaussian profile across,
    except behind nearer surfaces."""
    height, width = depth.shape
    reach = 3.0 * sigma
    low = np.maximum(np.floor(np.minimum(head, tail) - reach), 0).astype(int)
    high = np.minimum(np.ceil(np.maximum(head, tail) + reach) + 1, [width, height]).astype(int)
    if np.any(low >= high):
        return
    part = (slice(low[1], high[1]), slice(low[0], high[0]))
    y, x = np.mgrid[part]
    along = tail - head
    fraction = np.clip(
        ((x - head[0]) * along[0] + (y - head[1]) * along[1]) / max(float(along @ along), 1e-9),
        0.0,
        1.0,
    )
    squared = (x - head[0] - fraction * along[0]) ** 2 + (y - head[1] - fraction * along[1]) ** 2
    alpha = share * np.exp(-0.5 * squared / sigma**2) * ~(depth[part] < z)
    image[part] += alpha.astype(np.float32)[:, :, None] * (glow - image[part])
