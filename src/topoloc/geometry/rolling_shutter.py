"""Estimate how much a camera turned while a rolling shutter read its rows.

A camera that turns shears and stretches its image. Pose and calibration would have to explain it:
one degree during a frame turns the pose by up to half a degree, and asks for another focal length.
Gauss-Newton estimates the pose of the middle row and a rotation proportional to the rows together.
The rotation is believed only if its evidence beats that of a camera at rest. A translation during a
frame is small beside the distance of the points, and is left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from topoloc.geometry.camera import Camera
from topoloc.geometry.joint_camera.camera_hypotheses import unchanged_camera
from topoloc.geometry.joint_camera.joint_fit import CameraObservations, clustered_noise
from topoloc.geometry.pose_matches import CAUCHY_SCALE, cells_of, estimate_noise_scale
from topoloc.geometry.rigid import Rigid3

_ROTATION_SIGMA = math.radians(1.5)  # of one axis, during a frame: a hand turns 50 deg/s and more


@dataclass(frozen=True, eq=False)
class TurningCamera:
    """Hold the pose of the middle row and the rotation (radians, camera axes) from the first to the
    last row. `covariance` is what the rotation adds to that of the pose (left perturbation).

    A rotation `is_evident`, or is only as good an explanation of what contradicts a calibration.
    """

    cam_from_world: Rigid3
    rotation: Float[np.ndarray, " 3"]
    covariance: Float[np.ndarray, "6 6"]
    height: int
    is_evident: bool = True

    def undo(self, points_img: Float[np.ndarray, "n 2"], camera: Camera) -> np.ndarray:
        """Return where pixels would be if all rows were read with the middle one. Pixels without a
        ray stay."""
        rays = np.insert(camera.normalized_from_img(points_img), 2, 1.0, axis=1)
        shares = _row_shares(points_img, self.height)
        moved = camera.img_from_cam(rays - shares[:, None] * np.cross(self.rotation, rays))
        return np.where(np.isfinite(moved), moved, points_img)


def _row_shares(points_img: Float[np.ndarray, "n 2"], height: int) -> Float[np.ndarray, " n"]:
    """Return the time of each pixel's row, from -0.5 to 0.5 of a frame."""
    return (points_img[:, 1] + 0.5) / height - 0.5


def find_rotation(
    points_img: Float[np.ndarray, "n 2"],
    points_world: Float[np.ndarray, "n 3"],
    covariances: Float[np.ndarray, "n 3 3"],
    sigmas_px: float | Float[np.ndarray, " n"],
    camera: Camera,
    cam_from_world: Rigid3,
    variance: float = 1.0,
) -> TurningCamera | None:
    """Return the pose with the rotation during the frame, None if the camera may be at rest.

    Args:
        points_img: n pixels that agree with the pose.
        points_world: the world points that they show (metres), with covariances (m^2).
        sigmas_px: standard deviation of the pixels.
        variance: factor of the variance by errors that all points share.
    """
    # `benchmarks/inputs.py`: calm images had up to 16, by errors of the map, turns of a degree 2 to
    # 360; after one round, which counts the rotation as noise, -7 to -12 and 1 to 15. Images
    # through a lens that the calibration leaves out had up to 4.
    num_rounds, min_first_log_odds, min_log_odds, evident_log_odds = 5, -3.0, 4.0, 15.0
    seen = CameraObservations(
        camera.normalized_from_img(points_img),
        np.asarray(sigmas_px) / camera.fx,
        points_world,
        covariances,
        cells_of(points_img, camera.width, camera.height),
        math.inf,
    )
    shares = _row_shares(points_img, camera.height)
    estimate, is_evident = _Estimate(cam_from_world, np.zeros(3)), True
    for number in range(num_rounds):
        improved = estimate.improved(seen, shares, variance)
        if improved is None:
            return None
        estimate = improved
        if estimate.log_odds < (min_log_odds if number else min_first_log_odds):
            return None
        is_evident &= number == 0 or estimate.log_odds >= evident_log_odds
    by_turn = estimate.pose_by_rotation
    covariance = by_turn @ estimate.covariance @ by_turn.T
    return TurningCamera(
        estimate.cam_from_world, estimate.rotation, covariance, camera.height, is_evident
    )


@dataclass(frozen=True, eq=False)
class _Estimate:
    """Hold a pose, a rotation, and the log odds of a turning camera against one at rest.
    `covariance` is that of the rotation."""

    cam_from_world: Rigid3
    rotation: Float[np.ndarray, " 3"]
    log_odds: float = 0.0
    covariance: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    pose_by_rotation: Float[np.ndarray, "6 3"] = field(default_factory=lambda: np.zeros((6, 3)))

    def improved(
        self, seen: CameraObservations, shares: Float[np.ndarray, " n"], variance: float
    ) -> _Estimate | None:
        """Return the estimate after a round of Gauss-Newton, None if the points do not fix it."""
        jacobian, weights, errors = seen.linearize(self.cam_from_world, unchanged_camera())
        by_rotation = shares[:, None, None] * jacobian[:, :, 3:6]
        errors = errors + by_rotation @ self.rotation
        squares = np.einsum("ni,nij,nj->n", errors, weights, errors)
        jacobian = np.concatenate([jacobian[:, :, :6], by_rotation], axis=2)
        weighted = (weights / (1.0 + squares / CAUCHY_SCALE**2)[:, None, None]) @ jacobian
        information = np.tensordot(weighted, jacobian, ((0, 1), (0, 1)))
        gradients = (weighted * errors[:, :, None]).sum(axis=1)
        noise = variance * estimate_noise_scale(squares, 9) ** 2
        noise *= clustered_noise(information, gradients, seen.cells, slice(6, 9))
        prior = np.diag([0.0] * 6 + [noise / _ROTATION_SIGMA**2] * 3)
        try:
            inverse = np.linalg.inv(information + prior)
            known = np.linalg.inv(np.linalg.inv(information)[6:, 6:]) / noise
            by_turn = -np.linalg.solve(information[:6, :6], information[:6, 6:])
        except np.linalg.LinAlgError:
            return None
        step = -inverse @ (gradients.sum(axis=0) + prior[:, 6:] @ self.rotation)
        if not np.isfinite(step).all():
            return None
        rotation = self.rotation + step[6:]
        cam_from_world = Rigid3.exp(step[:6]) @ self.cam_from_world
        # the odds against a camera at rest, by the estimate with the prior and the information of
        # the image without it
        posterior = known + np.eye(3) / _ROTATION_SIGMA**2
        gain = 0.5 * float(rotation @ posterior @ rotation)
        log_odds = gain - 0.5 * float(np.linalg.slogdet(posterior * _ROTATION_SIGMA**2)[1])
        return _Estimate(cam_from_world, rotation, log_odds, noise * inverse[6:, 6:], by_turn)
