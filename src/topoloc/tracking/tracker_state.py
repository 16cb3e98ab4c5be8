"""Hold the state of the tracker: the current image, the last localized ones and their errors.

The error of a localization has two parts. The noise of the matches is independent from image to
image. The common error of the map's points (`correlated_errors.py`) is not. An image taken nearby
uses the same points and has the same error, so averaging over images does not reduce it. When the
camera moves on, other points take over and this part changes slowly, faster for nearer points. It
is modelled as a first-order Gauss-Markov process (Gelb, *Applied Optimal Estimation*, 1974, section
3.8) in s = distance / depth + rotation. Two images have the share exp(-s / reach) of it in common.
They differ by 2 (1 - exp(-s / reach)) of its covariance.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.exact.appearance import load_appearance_weights
from topoloc.localization.query import Deadline
from topoloc.localization.result import Localization, NotLocalized
from topoloc.retrieval.coarse import Image
from topoloc.slam.pose_graph import PoseGraphEdge, optimize_pose_graph
from topoloc.tracking.motion import MotionState
from topoloc.tracking.point_tracker import PointTracker, TrackedMotion


@dataclass(frozen=True, eq=False)
class StreamFrame:
    """Hold the current image, its time and external odometry.

    `grey` is the image in grey, reduced, and `grey_camera` its camera. Searches end at `limit`.
    """

    image: Image
    camera: Camera
    t_ns: int
    odom_from_cam: Rigid3 | None
    grey: UInt8[np.ndarray, "a b"]
    grey_camera: Camera
    limit: Deadline


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
    way = float(np.linalg.norm(cam_from_before.translation))
    moved = way / errors.depth + cam_from_before.angle()
    return 2.0 * (1.0 - np.exp(-moved / reach)) * errors.correlated


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


@dataclass(frozen=True, eq=False)
class TrackedImage:
    """Hold the current image, tracked from the last localized one (`reference`): its motion since,
    and its smoothed cam_from_world."""

    reference: ReferenceImage
    motion: TrackedMotion
    smoothed: Rigid3

    @property
    def cam_from_world(self) -> Rigid3:
        """Return the raw pose."""
        return self.motion.cam_from_ref @ self.reference.cam_from_world

    @property
    def moved_errors(self) -> Float[np.ndarray, "6 6"]:
        """Return the covariance of the error of the reference image, moved to this image."""
        return self.motion.cam_from_ref.transform_covariance(self.reference.errors.total)


def compute_motion_covariance(tracked_motion: TrackedMotion) -> Float[np.ndarray, "6 6"]:
    """Return the covariance of a tracked motion: the noise of the points, and a share of the motion
    for wrong depths."""
    motion, share = tracked_motion.cam_from_ref, 0.05
    way, turn = float(np.linalg.norm(motion.translation)), motion.angle()
    return tracked_motion.covariance + np.diag(np.repeat([way**2, turn**2], 3)) * share**2


def compute_smoothed_covariance(
    reference: ReferenceImage | None, since: MotionState | None = None
) -> Float[np.ndarray, "6 6"]:
    """Return the covariance of the left perturbation of the smoothed world_from_cam.

    It adds the error of the last localized image and of the motion since.
    """
    covariance = np.zeros((6, 6))
    if reference is not None:
        covariance = reference.smoothed.inverse().transform_covariance(reference.covariance)
    if since is None:
        return covariance
    return covariance + since.world_from_cam.transform_covariance(since.pose_covariance)


def fade_offset(offset: Rigid3, seconds: float) -> Rigid3:
    """Return the rest of a correction of the smoothed pose after a time."""
    # Time constant (to 1/e, seconds) of the correction of the smoothed pose by a new
    # localization. It prevents jumps.
    blend_time = 0.2
    return Rigid3.exp(np.exp(-seconds / blend_time) * offset.log())


_Estimate = tuple[Rigid3, Float[np.ndarray, "6 6"]]
"""A transform and the covariance of its left perturbation."""


class PoseWindow:
    """Hold the last `size` localized images, which are adjusted together.

    Localization has about a centimetre of noise, point tracking a tenth of that. A pose graph over
    the images (`slam/pose_graph.py`) combines the two. Its node 0 is the world. A robust loss
    limits the influence of a wrong localization.
    """

    def __init__(self, size: int = 10) -> None:
        # poses and motions since the image before; that of the first image is not used
        self._measured: deque[tuple[_Estimate, _Estimate]] = deque(maxlen=size)
        self._smoothed: deque[Rigid3] = deque(maxlen=size)
        self._covariance = np.zeros((6, 6))  # of the last one of these

    def clear(self) -> None:
        """Remove all images."""
        self._measured.clear()
        self._smoothed.clear()

    def add(
        self,
        cam_from_world: Rigid3,
        covariance: Float[np.ndarray, "6 6"],
        cam_from_before: Rigid3,
        motion_covariance: Float[np.ndarray, "6 6"],
    ) -> tuple[Rigid3, Float[np.ndarray, "6 6"]]:
        """Add an image, localized at `cam_from_world` after the motion `cam_from_before` since the
        last added image. Return its smoothed cam_from_world. All covariances are those of left
        perturbations."""
        if self._smoothed:
            before = cam_from_before.transform_covariance(self._covariance) + motion_covariance
            both = before @ np.linalg.solve(before + covariance, covariance)
            self._covariance = (both + both.T) / 2.0  # symmetric up to rounding
        else:
            self._covariance = covariance
        before = self._smoothed[-1] if self._smoothed else None
        self._smoothed.append(cam_from_world if before is None else cam_from_before @ before)
        self._measured.append(((cam_from_world, covariance), (cam_from_before, motion_covariance)))
        edges = list[PoseGraphEdge]()
        for k, (pose, motion) in enumerate(self._measured, start=1):
            edges.append(PoseGraphEdge(0, k, *pose, is_loop=True))
            if k > 1:
                edges.append(PoseGraphEdge(k - 1, k, *motion, is_loop=True))
        poses = optimize_pose_graph(
            [Rigid3.identity(), *self._smoothed], edges, max_steps=5, min_step=1e-4
        )
        self._smoothed = deque(poses[1:], maxlen=self._smoothed.maxlen)
        return self._smoothed[-1], self._covariance


class FloorEvidence:
    """Hold the log-odds of the appearances at the last places of a stream.

    One image may not tell floors apart. Images of other places are nearly independent, so their
    log-odds add up.
    """

    def __init__(self, has_look_alikes: bool) -> None:
        self._has_look_alikes = has_look_alikes
        self._seen = list[tuple[Rigid3 | None, float]]()

    def add(self, result: Localization | NotLocalized) -> None:
        """Add an image, unless it is of the last place. Successive refusals are of one place."""
        max_places, min_metres, min_radians, max_log_odds = 5, 0.5, 0.5, 4.0
        pose = result.world_from_cam if isinstance(result, Localization) else None
        is_known = False
        if self._seen:
            last = self._seen[-1][0]
            is_known = last is pose  # both refused
            if last is not None and pose is not None:
                is_known = last.is_same(pose, min_metres, min_radians)
        if result.appearance is not None and not is_known:
            appearance = min(max(result.appearance, 1e-6), 1.0 - 1e-6)
            log_odds = math.log(appearance / (1.0 - appearance))
            log_odds = min(max(log_odds, -max_log_odds), max_log_odds)
            self._seen = [*self._seen, (pose, log_odds)][-max_places:]

    @property
    def is_sure(self) -> bool:
        """Return whether the places are of this floor. In a map with look-alike floors fewer than
        three do not suffice."""
        weights, num, is_enough = load_appearance_weights(), len(self._seen), len(self._seen) >= 3
        least = math.log(weights.floor_odds[self._has_look_alikes])
        if is_enough:  # the mean of more places varies less
            least += weights.places_log_odds[self._has_look_alikes] * math.sqrt(3.0 / num)
        # a floor that resembles this one does so at many places, so more add no more than three
        seen = sum(log_odds for _, log_odds in self._seen) * 3.0 / max(3.0, num)
        return seen >= least and (is_enough or not self._has_look_alikes)
