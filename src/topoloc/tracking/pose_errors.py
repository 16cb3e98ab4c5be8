"""What a localization is wrong by, in two parts: what differs from picture to picture, and what
lasts.

The noise of a picture's matches is another one in the next picture. What the map's points have in
common (`correlated_errors.py`) is not: a picture taken close by stands on the same points and is
wrong by the same, so no number of pictures averages it away. Where the camera moves on, other
points take over, and the lasting part changes by and by, the sooner the nearer the points are. It
is taken for a Gauss-Markov process of first order (Gelb, *Applied Optimal Estimation*, 1974,
section 3.8) in s = way / depth + turn: two pictures have the share exp(-s / reach) of it in common,
and differ by 2 (1 - exp(-s / reach)) of its covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from topoloc.geometry.rigid import Rigid3
from topoloc.localization.result import Localization


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Covariances of the left perturbation of cam_from_world, in the camera's axes (m, rad);
    `depth` of the points, metres."""

    noise: Float[np.ndarray, "6 6"]
    correlated: Float[np.ndarray, "6 6"]
    depth: float

    @property
    def total(self) -> Float[np.ndarray, "6 6"]:
        return self.noise + self.correlated


def compute_pose_errors(found: Localization, depth: float, floor_share: float) -> PoseErrors:
    """The two parts, of points at this depth (metres); the noise is not below `noise_floor`."""
    noise = found.noise_share * found.camera_covariance
    return PoseErrors(
        noise + noise_floor(depth, floor_share), found.camera_covariance - noise, depth
    )


def noise_floor(depth: float, share: float) -> Float[np.ndarray, "6 6"]:
    """What is left however many points there are: sigma is `share` of their depth (metres), and as
    many radians."""
    return np.diag(np.repeat([(share * depth) ** 2, share**2], 3))


def compute_correlated_change(
    errors: PoseErrors, cam_from_before: Rigid3, reach: float
) -> Float[np.ndarray, "6 6"]:
    """The covariance by which the lasting part differs from that of another picture,
    `cam_from_before` away."""
    moved = (
        float(np.linalg.norm(cam_from_before.translation)) / errors.depth + cam_from_before.angle()
    )
    return 2.0 * (1.0 - np.exp(-moved / reach)) * errors.correlated
