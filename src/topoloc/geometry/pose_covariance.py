"""The covariance of a pose, seen from its other side."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from topoloc.geometry.rigid import Rigid3


def covariance_of_inverse(a_from_b: Rigid3, covariance: Float[np.ndarray, "6 6"]) -> Float[np.ndarray, "6 6"]:
    """Covariance of the left perturbation of ``b_from_a = a_from_b.inverse()``, from that of `a_from_b`.

    As ``(exp(xi) @ a_from_b).inverse() == exp(-Ad @ xi) @ b_from_a`` with Ad the adjoint of b_from_a.
    The result's translation part is of the frame b at its origin; see `position_covariance` for the camera's own position.
    """
    adjoint = a_from_b.inverse().adjoint()
    return adjoint @ covariance @ adjoint.T


def position_covariance(cam_from_world: Rigid3, covariance: Float[np.ndarray, "6 6"]) -> Float[np.ndarray, "3 3"]:
    """Covariance (m^2, world axes) of the camera's position, from that of the left perturbation of `cam_from_world`.

    The position is ``-R' t``; moving R and t by (rho, omega) moves it by ``-R' rho`` alone, to first order.
    """
    return cam_from_world.rotation.T @ covariance[:3, :3] @ cam_from_world.rotation
