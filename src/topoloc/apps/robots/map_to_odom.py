"""Decide which measured poses move the transform from map to odom, and how it follows them.

Only images that were matched with the map are evidence, never poses predicted by odometry. A pose
that agrees with the present transform updates it. Poses that contradict it must agree among each
other, by the motion that odometry measured between them, before they replace it (a jump). The
published transform moves smoothly, or at once. Poses of a camera without odometry must continue
each other instead.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import Float

from topoloc import NotLocalized, Rigid3, StreamedPose

Verdict = Literal["found", "jumped", "doubted"]


@dataclass(frozen=True, eq=False)
class MeasuredPose:
    """Hold the pose of an image.

    Attributes:
        t_ns: time of the image.
        map_from_cam: measured pose.
        covariance: that of its left perturbation.
        odom_from_cam: pose by odometry.
        travelled: way and rotation by odometry since the start, metres and radians.
        is_localized: matched with the whole map. Otherwise points were tracked, whose errors are
            those of the last such image.
    """

    t_ns: int
    map_from_cam: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    odom_from_cam: Rigid3
    travelled: Float[np.ndarray, "2"]
    is_localized: bool

    @property
    def map_from_odom(self) -> Rigid3:
        """Return the transform that this pose measures."""
        return self.map_from_cam @ self.odom_from_cam.inverse()

    @property
    def local_covariance(self) -> Float[np.ndarray, "6 6"]:
        """Return the covariance of the right perturbation, in axes of the camera."""
        return self.map_from_cam.inverse().transform_covariance(self.covariance)


class HealthGate:
    """Hold the agreed transform from map to odom. `agreed` is its last evidence.

    Args:
        num_confirming: localized images that must agree by odometry on a first pose or a jump.
    """

    min_probability: ClassVar[float] = 0.8
    """Least probability of a pose that counts as evidence."""
    odometry_error: ClassVar[float] = 0.05
    """Error of the odometry, as a share of the way and of the rotation (one sigma)."""

    def __init__(self, num_confirming: int = 3) -> None:
        self._num_confirming = num_confirming
        self.agreed: MeasuredPose | None = None
        self._against: list[MeasuredPose] = []
        self._prior: MeasuredPose | None = None

    @property
    def is_contradicted(self) -> bool:
        """Return whether the last images contradict the agreed transform."""
        return bool(self._against)

    def reset(self) -> None:
        """Forget everything."""
        self.agreed = self._prior = None
        self._against = []

    def expect(self, prior: MeasuredPose) -> None:
        """Take a pose that a user gave. The next one that agrees with it is confirmed by that."""
        self._prior = prior

    def judge(self, evidence: MeasuredPose) -> Verdict:
        """Take the pose of an image.

        Return "found" if it agrees with the transform, "jumped" if it is the last of several that
        confirm another one, else "doubted". "doubted" poses are not to be published.
        """
        if self.agreed is not None and self._agree(self.agreed, evidence):
            self.agreed, self._against = evidence, []
            return "found"
        if not evidence.is_localized:
            return "doubted"
        if self._against and not self._agree(self._against[-1], evidence):
            self._against = []
        self._against.append(evidence)
        is_expected = self._prior is not None and self._agree(self._prior, evidence)
        if not (is_expected or self._is_confirmed()):
            return "doubted"
        self.agreed, self._against, self._prior = evidence, [], None
        return "jumped"

    def _is_confirmed(self) -> bool:
        first, last = self._against[0], self._against[-1]
        if len(self._against) < self._num_confirming or self.agreed is None:
            return len(self._against) >= self._num_confirming
        # Images of a robot that stands (metres and radians) have the same errors.
        still, moving_s, standing_s = 0.1, 1.0, 2.0
        is_still = bool(np.all(last.travelled - first.travelled < still))
        seconds = standing_s if is_still else moving_s
        return last.t_ns - first.t_ns >= seconds * 1e9

    def _agree(self, before: MeasuredPose, after: MeasuredPose) -> bool:
        """Return whether two poses are the same but for the motion by odometry between them."""
        metres, radians = 0.05, 0.05  # smaller differences are none
        max_surprise = 33.0  # chi^2 of 6 degrees of freedom: 1 in 100,000
        motion = before.odom_from_cam.inverse() @ after.odom_from_cam
        way_and_turn = np.abs(after.travelled - before.travelled)
        sigmas = self.odometry_error * np.repeat(way_and_turn, 3) + 1e-3
        to_after = motion.inverse()
        return (before.map_from_cam @ motion).is_same(
            after.map_from_cam,
            metres,
            radians,
            covariance=to_after.transform_covariance(before.local_covariance)
            + after.local_covariance
            + np.diag(sigmas**2),
            max_square=max_surprise,
        )


@dataclass(frozen=True, eq=False)
class StreamPose:
    """Hold the pose of an image in a stream without odometry from outside.

    Attributes:
        sigma: standard deviation of the position, metres.
        track: that of `StreamedPose`.
    """

    t_ns: int
    map_from_cam: Rigid3
    sigma: float
    track: int | None


class ContinuityGate:
    """Decide which poses of a camera without odometry are published. A pose must continue those
    before it: by their velocity, and by the acceleration that the camera may have.

    Args:
        num_confirming: successive images that must agree on a first pose, after a loss and on a
            jump.
    """

    max_gap: ClassVar[float] = 2.0
    """Seconds without a pose after which the next one does not continue it."""

    def __init__(self, num_confirming: int = 3) -> None:
        self._num_confirming = num_confirming
        self._agreed, self._against = list[StreamPose](), list[StreamPose]()
        self._is_broken = self._is_refuted = False

    @property
    def is_contradicted(self) -> bool:
        """Return whether the last images contradict the agreed pose."""
        return bool(self._against)

    def observe(self, answer: StreamedPose) -> None:
        """Take the answer for any image. After a loss, a jump or an ambiguity of the stream images
        must agree anew. A pose of another track is then no continuation of the last one, unless
        that had ended for lack of images."""
        end = 1.0  # seconds without images after which streams end
        result, is_unclear = answer.result, answer.state == "ambiguous"
        is_jump = isinstance(result, NotLocalized) and result.reason == "jump"
        self._is_broken |= is_jump or is_unclear or answer.state == "lost"
        if self._agreed:
            gap = (answer.t_ns - self._agreed[-1].t_ns) / 1e9
            self._is_refuted |= is_jump or (is_unclear and gap <= end)

    def judge(self, seen: StreamPose) -> Verdict:
        """Take the pose of an image, see `HealthGate.judge`."""
        if self._agreed and not self._is_broken and self._continues(self._agreed, seen):
            return self._agree([*self._agreed, seen], "found")
        if self._against and not self._continues(self._against, seen):
            self._against = []
        self._against.append(seen)
        if len(self._against) < self._num_confirming:
            return "doubted"
        first, last = self._against[0], self._agreed[-1] if self._agreed else None
        is_same = last is not None and not (self._is_refuted and first.track != last.track)
        is_same = is_same and self._continues(self._agreed, first)
        return self._agree(self._against, "found" if is_same else "jumped")

    def _agree(self, poses: list[StreamPose], verdict: Verdict) -> Verdict:
        span_ns = 500_000_000  # over which velocity is measured
        newest = poses[-1].t_ns
        kept = [one for one in poses if newest - one.t_ns <= span_ns]
        self._agreed, self._against = kept if len(kept) > 1 else poses[-2:], []
        self._is_broken = self._is_refuted = False
        return verdict

    def _continues(self, before: list[StreamPose], after: StreamPose) -> bool:
        """Return whether a camera that was at some poses can be at another one later."""
        first, last = before[0], before[-1]
        seconds, span = (after.t_ns - last.t_ns) / 1e9, (last.t_ns - first.t_ns) / 1e9
        if seconds > self.max_gap:
            return False
        least_rad, turn = 0.3, 3.0  # radians, radians per second
        if span <= 0.0:  # of unknown velocity
            least_m, speed = 0.3, 5.0
            metres = least_m + speed * seconds
            return after.map_from_cam.is_same(last.map_from_cam, metres, least_rad + turn * seconds)
        velocity = (last.map_from_cam.translation - first.map_from_cam.translation) / span
        predicted = Rigid3(
            last.map_from_cam.rotation, last.map_from_cam.translation + velocity * seconds
        )
        # two sigma of the motion model of streams, and of both poses: most of their errors are one
        least_m, most_m, acceleration = 0.15, 0.25, 6.0
        metres = least_m + min(2.0 * math.hypot(last.sigma, after.sigma), most_m)
        metres += 0.5 * acceleration * seconds**2
        return after.map_from_cam.is_same(predicted, metres, least_rad + turn * seconds)


class MapToOdom:
    """Hold the published transform, and the one that it moves to.

    Args:
        speed: metres per second by which smooth corrections move the robot.
        turn_rate: radians per second by which they turn it.
    """

    def __init__(self, speed: float = 0.5, turn_rate: float = 0.5) -> None:
        self._speed, self._turn_rate = speed, turn_rate
        self._target: Rigid3 | None = None
        self._published = Rigid3.identity()
        self._odom_from_base, self._last = Rigid3.identity(), 0.0

    def reset(self) -> None:
        """Forget the transform."""
        self._target = None

    def set_target(self, map_from_base: Rigid3, odom_from_base: Rigid3, at_once: bool) -> None:
        """Take the agreed pose of the robot, measured and by odometry at the same time."""
        is_first, self._odom_from_base = self._target is None, odom_from_base
        self._target = map_from_base @ odom_from_base.inverse()
        if is_first or at_once:
            self._published = self._target

    def advance(self, seconds: float) -> Rigid3 | None:
        """Return map_from_odom at `seconds`, of any clock that goes on. None: not known yet."""
        elapsed, self._last = max(seconds - self._last, 0.0), seconds
        if self._target is None:
            return None
        # Corrections turn about the robot, since those about the origin of odom swing it.
        now, then = (one @ self._odom_from_base for one in (self._published, self._target))
        way = float(np.linalg.norm(then.translation - now.translation))
        turn = (now.inverse() @ then).angle()
        need = max(way / self._speed, turn / self._turn_rate)
        if need <= elapsed:
            self._published = self._target
        else:
            moved = now.interpolate(then, elapsed / need)
            self._published = moved @ self._odom_from_base.inverse()
        return self._published


def project_to_plane(pose: Rigid3) -> Rigid3:
    """Return x, y and yaw of a pose in a frame whose z points up."""
    x, y = pose.translation[:2]
    yaw = math.atan2(pose.rotation[1, 0], pose.rotation[0, 0])
    turn = np.array([0.0, 0.0, 0.0, 0.0, 0.0, yaw])
    return Rigid3(Rigid3.exp(turn).rotation, np.array([x, y, 0.0]))


def tilt(pose: Rigid3) -> float:
    """Return the angle between the z axes of both frames, radians."""
    return math.acos(max(-1.0, min(1.0, float(pose.rotation[2, 2]))))
