"""Hold the state of the tracker: the current image and the last localized one."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.result import Localization
from topoloc.retrieval.coarse import Image
from topoloc.tracking.motion import MotionState
from topoloc.tracking.point_tracker import PointTracker, TrackedMotion
from topoloc.tracking.pose_errors import PoseErrors


@dataclass(frozen=True, eq=False)
class StreamFrame:
    """Hold the current image, its time and external odometry.

    `grey` is the image in grey, reduced, and `grey_camera` its camera.
    """

    image: Image
    camera: Camera
    t_ns: int
    odom_from_cam: Rigid3 | None
    grey: UInt8[np.ndarray, "a b"]
    grey_camera: Camera


@dataclass(frozen=True, eq=False)
class ReferenceImage:
    """Hold the last localized image: its raw and smoothed pose, their errors and its points.

    `covariance` is that of the left perturbation of `smoothed`, including the errors of the map.
    `offset` (left of `smoothed`) is the difference to the smoothed poses before this image. It
    fades over time.
    """

    t_ns: int
    found: Localization
    cam_from_world: Rigid3
    errors: PoseErrors
    smoothed: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    offset: Rigid3
    follower: PointTracker


def compute_direction_uncertainty(predicted: MotionState, depth: float) -> float:
    """Return three sigma (radians) of the direction to points at this depth (metres)."""
    sigmas = np.sqrt(np.diag(predicted.pose_covariance))
    return 3.0 * float(np.hypot(sigmas[:3].max() / depth, sigmas[3:].max()))


def compute_motion_covariance(
    tracked_motion: TrackedMotion, share: float = 0.05
) -> Float[np.ndarray, "6 6"]:
    """Return the covariance of a tracked motion: the noise of the points, and `share` of the motion
    for wrong depths."""
    way, turn = (
        float(np.linalg.norm(tracked_motion.cam_from_ref.translation)),
        tracked_motion.cam_from_ref.angle(),
    )
    return tracked_motion.covariance + np.diag(np.repeat([way**2, turn**2], 3)) * share**2


def compute_smoothed_covariance(
    reference: ReferenceImage | None, since: MotionState | None = None
) -> Float[np.ndarray, "6 6"]:
    """Return the covariance of the left perturbation of the smoothed world_from_cam.

    It adds the error of the last localized image and of the motion since.
    """
    covariance = np.zeros((6, 6))
    if reference is not None:
        adjoint = reference.smoothed.inverse().adjoint()
        covariance = adjoint @ reference.covariance @ adjoint.T
    if since is None:
        return covariance
    adjoint = since.world_from_cam.adjoint()
    return covariance + adjoint @ since.pose_covariance @ adjoint.T


def downscale_image(
    grey: UInt8[np.ndarray, "h w"], camera: Camera, max_side_px: int
) -> tuple[UInt8[np.ndarray, "a b"], Camera]:
    """Return the image and its camera, reduced if a side is longer than `max_side_px`."""
    scale = max_side_px / max(grey.shape)
    if scale >= 1.0:
        return grey, camera
    width, height = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    return cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA), camera.rescaled(
        width, height
    )
