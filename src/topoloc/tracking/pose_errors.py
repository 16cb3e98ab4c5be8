"""Split the error of a localization into independent noise and a correlated part.

The noise of the matches is independent from image to image. The common error of the map's points
(`correlated_errors.py`) is not. An image taken nearby uses the same points and has the same error,
so averaging over images does not reduce it. When the camera moves on, other points take over and
this part changes slowly, faster for nearer points. It is modelled as a first-order Gauss-Markov
process (Gelb, *Applied Optimal Estimation*, 1974, section 3.8) in s = distance / depth + rotation.
Two images have the share exp(-s / reach) of it in common. They differ by 2 (1 - exp(-s / reach)) of
its covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from topoloc.geometry.rigid import Rigid3
from topoloc.localization.result import Localization


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Hold both covariances of the left perturbation of cam_from_world, in camera axes (m, rad).

    `depth` is the median depth of the points, metres.
    """

    noise: Float[np.ndarray, "6 6"]
    correlated: Float[np.ndarray, "6 6"]
    depth: float

    @property
    def total(self) -> Float[np.ndarray, "6 6"]:
        """Return the covariance of the whole error."""
        return self.noise + self.correlated


def compute_pose_errors(
    found: Localization, depth: float, floor_share: float = 0.001
) -> PoseErrors:
    """Return both parts for points at this depth (metres). `noise_floor` is added to the noise."""
    noise = found.noise_share * found.camera_covariance
    return PoseErrors(
        noise + noise_floor(depth, floor_share), found.camera_covariance - noise, depth
    )


def noise_floor(depth: float, share: float = 0.001) -> Float[np.ndarray, "6 6"]:
    """Return the noise that remains with any number of points.

    Its sigma is `share` of their depth (metres), and `share` radians.
    """
    return np.diag(np.repeat([(share * depth) ** 2, share**2], 3))


def compute_correlated_change(
    errors: PoseErrors, cam_from_before: Rigid3
) -> Float[np.ndarray, "6 6"]:
    """Return the covariance of the change of the correlated part between two images.

    `cam_from_before` is the motion between them.
    """
    # Motion over which map errors are correlated (to 1/e): the distance in depths of the points,
    # plus the rotation in radians.
    reach = 2.0
    moved = (
        float(np.linalg.norm(cam_from_before.translation)) / errors.depth + cam_from_before.angle()
    )
    return 2.0 * (1.0 - np.exp(-moved / reach)) * errors.correlated
