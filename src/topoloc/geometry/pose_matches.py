"""Hold matches of pixels with world points for the kernels of pose estimation. Refine a pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from topoloc.geometry.absolute_pose_kernels import refine
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3

_Array = np.ndarray
MIN_POINTS = 4
CAUCHY_SCALE = 2.3849  # 95 % efficiency on Gaussian residuals (Holland and Welsch, 1977)


@dataclass(frozen=True, eq=False)
class Matches:
    """Hold the usable matches: pixels, their coordinates and covariances on the plane z = 1, and
    world points."""

    points_img: Float[np.ndarray, "n 2"]
    normalized: Float[np.ndarray, "n 2"]
    covariances: Float[np.ndarray, "n 2 2"]
    points_world: Float[np.ndarray, "n 3"]
    point_covariances: Float[np.ndarray, "n 3 3"] | Float[np.ndarray, "0 3 3"]

    @staticmethod
    def from_pixels(
        points_img: _Array,
        points_world: _Array,
        covariances: _Array,
        camera: Camera,
        sigma_px: float | Float[np.ndarray, " n"],
        normalized: Float[np.ndarray, "n 2"] | None = None,
    ) -> Matches:
        """Create matches from pixels, world points (metres) and the points' covariances (m^2).
        `sigma_px` is the standard deviation of the pixels, one for all or one for each.
        `normalized` are the pixels on the plane z = 1, if known."""
        if normalized is None:
            normalized = camera.normalized_from_img(points_img)
        sigmas = np.asarray(sigma_px)[..., None, None]
        to_normalized = sigmas * camera.normalized_jacobian(normalized)
        return Matches(
            points_img=np.ascontiguousarray(points_img, dtype=np.float64),
            normalized=normalized,
            covariances=to_normalized @ to_normalized.transpose(0, 2, 1),
            points_world=np.ascontiguousarray(points_world, dtype=np.float64),
            point_covariances=np.ascontiguousarray(covariances, dtype=np.float64),
        )

    def kernel_args(self, cam_from_world: Rigid3) -> tuple[_Array, ...]:
        """Return the arguments that all kernels share."""
        rotation, translation = cam_from_world.rotation, cam_from_world.translation
        return (
            np.ascontiguousarray(rotation),
            np.ascontiguousarray(translation),
            self.normalized,
            self.covariances,
            self.points_world,
            self.point_covariances,
        )


def refine_pose(
    cam_from_world: Rigid3, matches: Matches, active: Bool[np.ndarray, " n"], max_steps: int = 10
) -> Rigid3:
    """Return the pose that fits the active matches best, starting from a nearby pose, in at most
    `max_steps` steps."""
    return Rigid3(*refine(*matches.kernel_args(cam_from_world), active, CAUCHY_SCALE, max_steps))


def is_non_collinear(points: Float[np.ndarray, "n 3"]) -> bool:
    """Return whether there are at least four points, not all on one line."""
    if len(points) < MIN_POINTS:
        return False
    centred = points - points.mean(axis=0)
    scatter = centred.T @ centred
    # Of variances a <= b <= c, trace^2 - |scatter|^2 is 2 (ab + ac + bc), between 2 bc and 6 bc.
    total = float(np.trace(scatter)) ** 2
    return total - float(np.vdot(scatter, scatter)) > 2e-9 * total
