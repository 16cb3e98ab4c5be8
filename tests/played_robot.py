"""Simulate a robot by messages. As drivers do, it publishes images, camera_info and TF over DDS in
real time. It also receives the messages of a localizer.

Its odometry drifts: it measures 2 % too much distance, and turns half a degree per metre to the
left.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from topoloc.apps.formats.bags.bag_poses import pose_of_transform
from topoloc.apps.formats.bags.messages import stamp_ns, stamped_transform
from topoloc.apps.robots.config import RobotConfig
from topoloc.apps.robots.ros_node import RosNode
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3, exp_so3

IMAGE_TOPIC = "/camera/image_raw"
TF_HZ = 50
SCALE_ERROR, TURN_PER_METRE = 0.02, np.radians(0.5)
# x forward, y left, z up from x right, y down, z forward
_LINK_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
STATIC = {
    ("base_link", "camera_link"): Rigid3(
        exp_so3(np.array([0.0, 0.1, 0.0])), np.array([0.2, 0.05, 0.4])
    ),
    ("camera_link", "camera_optical"): Rigid3(_LINK_FROM_OPTICAL, np.zeros(3)),
}
BASE_FROM_CAM = STATIC["base_link", "camera_link"] @ STATIC["camera_link", "camera_optical"]


@dataclass(frozen=True, eq=False)
class Step:
    """Hold the camera pose, its image, and whether the camera was moved without odometry."""

    world_from_cam: Rigid3
    picture: np.ndarray
    is_carried: bool = False


@dataclass(eq=False)
class Heard:
    """Store received messages: TF from map to odom as (arrival, stamp, pose), robot poses
    as (arrival, stamp, pose), and statuses as (arrival, level, text, values). Arrivals
    are nanoseconds."""

    transforms: list[tuple[int, int, Rigid3]] = field(default_factory=list)
    others: list[tuple[str, int, Rigid3]] = field(default_factory=list)
    poses: list[tuple[int, int, Rigid3]] = field(default_factory=list)
    statuses: list[tuple[int, int, str, dict[str, str]]] = field(default_factory=list)

    def map_from_odom(self, t_ns: int) -> Rigid3 | None:
        """Interpolate the transform at a time as tf2 does."""
        stamps = [stamp for _, stamp, _ in self.transforms]
        after = int(np.searchsorted(stamps, t_ns))
        if after in (0, len(stamps)):
            return None
        (_, t0, first), (_, t1, second) = self.transforms[after - 1 : after + 1]
        return first.interpolate(second, (t_ns - t0) / (t1 - t0))


class PlayedRobot:
    """Simulate a robot in a ROS domain. It plays `hz` images per second, one per step."""

    def __init__(self, camera: Camera, domain: int, hz: float = 10.0) -> None:
        self.camera, self.hz, self.heard = camera, hz, Heard()
        self.is_calibrated = True  # otherwise K is zero
        self.has_noise = True  # no two images of a real camera are equal
        self.encoding: str | None = None  # that of the images, or a wrong one
        self.has_info = True
        self._node = RosNode(RobotConfig(domain=domain))
        self.ros = ros = self._node.messages
        create = self._node.create_writer
        self._image = self._create_own_writer(IMAGE_TOPIC, ros.Image, "reliable")
        self._info = create("/camera/camera_info", ros.CameraInfo)
        self._tf = create("/tf", ros.TFMessage)
        self.initial_pose = create("/initialpose", ros.PoseWithCovarianceStamped)
        # Later readers get its last message as well.
        self._static = self._create_own_writer("/tf_static", ros.TFMessage, "latched")
        self._static.write(self._message([(*edge, pose) for edge, pose in STATIC.items()], 0))
        read = self._node.create_reader
        read("/tf", ros.TFMessage, "reliable", self._hear_tf)
        read("/topoloc/pose", ros.PoseWithCovarianceStamped, "reliable", self._hear_pose)
        read("/diagnostics", ros.DiagnosticArray, "reliable", self._hear_status)
        self.start_ns = 0
        self.steps: list[Step] = []
        self.odometry: list[Rigid3] = []

    def close(self) -> None:
        self._node.close()

    def wait_for_listener(self, seconds: float) -> bool:
        """Wait until a reader of the images is connected."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if self._image.get_matched_subscriptions():
                return True
            time.sleep(0.05)
        return False

    def stand(self, step: Step, until: Callable[[], bool], seconds: float) -> bool:
        """Play one step until the condition is true, and then half a second more."""
        end = time.monotonic() + seconds
        while not until() and time.monotonic() < end:
            self.play([step] * 5)
        if until():
            self.play([step] * 5)
        return until()

    def play(self, steps: Sequence[Step]) -> None:
        """Drive the steps, and keep the truth and odometry of this drive."""
        odom = self.odometry[-1] if self.odometry else BASE_FROM_CAM
        self.odometry, self.steps = [odom], list(steps)
        for before, after in pairwise(steps):
            if not after.is_carried:
                motion = before.world_from_cam.inverse() @ after.world_from_cam
                odom = odom @ _drifted(motion)
            self.odometry.append(odom)
        self.start_ns = time.time_ns() + 20_000_000
        images = threading.Thread(target=self._play_images)
        images.start()
        for number in range(round(TF_HZ * len(steps) / self.hz)):
            t_ns = self.start_ns + round(number * 1e9 / TF_HZ)
            _sleep_until(t_ns)
            odom_from_base = self.odom_from_cam(t_ns) @ BASE_FROM_CAM.inverse()
            self._tf(self._message([("odom", "base_link", odom_from_base)], t_ns))
        images.join()

    def odom_from_cam(self, t_ns: int) -> Rigid3:
        return self._at(self.odometry, t_ns)

    def world_from_cam(self, t_ns: int) -> Rigid3:
        return self._at([step.world_from_cam for step in self.steps], t_ns)

    def end_ns(self) -> int:
        return self.start_ns + round((len(self.steps) - 1) * 1e9 / self.hz)

    def errors(self, first: int = 0, last: int | None = None) -> np.ndarray:
        """Return the position errors in metres of the camera in TF (map, odom, base, camera), fifty
        per second, between two steps."""
        last = len(self.steps) - 1 if last is None else last
        found = list[float]()
        for t in np.arange(first / self.hz, last / self.hz, 1.0 / TF_HZ):
            t_ns = self.start_ns + round(1e9 * t)
            map_from_odom = self.heard.map_from_odom(t_ns)
            assert map_from_odom is not None, f"no TF from map to odom at {t:.2f} s"
            camera = (map_from_odom @ self.odom_from_cam(t_ns)).translation
            found.append(float(np.linalg.norm(camera - self.world_from_cam(t_ns).translation)))
        return np.array(found)

    def pose_errors(self) -> np.ndarray:
        """Return the position errors in metres of the published robot poses."""
        found = list[float]()
        for _, stamp, map_from_base in self.heard.poses:
            if self.start_ns <= stamp <= self.end_ns():
                truth = self.world_from_cam(stamp) @ BASE_FROM_CAM.inverse()
                found.append(float(np.linalg.norm(map_from_base.translation - truth.translation)))
        return np.array(found)

    def latencies(self) -> np.ndarray:
        """Return the seconds from the stamp of each image to its pose."""
        return np.array([(at - stamp) / 1e9 for at, stamp, _ in self.heard.poses])

    def gaps(self) -> np.ndarray:
        """Return the seconds between transforms from map to odom."""
        return np.diff([at for at, _, _ in self.heard.transforms]) / 1e9

    def make_initial_pose(self, map_from_base: Rigid3) -> Any:
        """Return the message of RViz's tool 2D Pose Estimate."""
        ros = self.ros
        ((stamped,),) = [self._message([("map", "", map_from_base)], time.time_ns()).transforms]
        place = stamped.transform.translation
        covariance = np.diag([0.25, 0.25, 0.0, 0.0, 0.0, 0.07]).ravel().tolist()
        pose = ros.Pose(ros.Point(place.x, place.y, place.z), stamped.transform.rotation)
        return ros.PoseWithCovarianceStamped(
            stamped.header, ros.PoseWithCovariance(pose, covariance)
        )

    def _at(self, poses: Sequence[Rigid3], t_ns: int) -> Rigid3:
        place = min(max((t_ns - self.start_ns) / 1e9 * self.hz, 0.0), len(poses) - 1.0)
        first = min(int(place), len(poses) - 1)
        if first + 1 == len(poses) or self.steps[first + 1].is_carried:
            return poses[first if place - first < 1.0 else first + 1]
        return poses[first].interpolate(poses[first + 1], place - first)

    def _play_images(self) -> None:
        ros, camera, noise = self.ros, self.camera, np.random.default_rng(0)
        fx, fy, cx, cy = camera.params
        matrix = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
        matrix = matrix if self.is_calibrated else [0.0] * 9
        projection = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
        roi = ros.RegionOfInterest(0, 0, 0, 0, False)
        for number, step in enumerate(self.steps):
            shown = step.picture.copy()
            if self.has_noise:
                shown.ravel()[noise.integers(0, shown.size, 50)] ^= 1
            height, width = shown.shape[:2]
            encoding = self.encoding or ("mono8" if shown.ndim == 2 else "rgb8")
            t_ns = self.start_ns + round(number * 1e9 / self.hz)
            header = ros.Header(ros.Time(*divmod(t_ns, 1_000_000_000)), "camera_optical")
            row = width * (1 if shown.ndim == 2 else 3)
            image = ros.Image(header, height, width, encoding, 0, row, shown.tobytes())
            rotation = np.eye(3).ravel().tolist()
            data = image.serialize()  # before its time, since a driver does this at once
            image.serialize = lambda *_, data=data, **__: data
            _sleep_until(t_ns)
            info = ros.CameraInfo(
                header, height, width, "plumb_bob", [0.0] * 5, matrix, rotation, projection,
                0, 0, roi,
            )  # fmt: skip
            if self.has_info:
                self._info(info)
            self._image.write(image)

    def _create_own_writer(self, name: str, kind: Any, quality: Any) -> Any:
        from cyclonedds.pub import DataWriter
        from cyclonedds.topic import Topic

        qos, participant = self._node._quality(quality), self._node._participant
        topic = Topic(participant, self._node.topic_name(name), kind, qos=qos)
        return DataWriter(participant, topic, qos=qos)

    def _message(self, edges: Sequence[tuple[str, str, Rigid3]], t_ns: int) -> Any:
        ros, stamp = self.ros, self.ros.Time(*divmod(t_ns, 1_000_000_000))
        stamped = []
        for parent, child, pose in edges:
            w, i, j, k = pose.quat_wxyz().tolist()
            moved = ros.Transform(
                ros.Vector3(*pose.translation.tolist()), ros.Quaternion(i, j, k, w)
            )
            stamped.append(ros.TransformStamped(ros.Header(stamp, parent), child, moved))
        return ros.TFMessage(stamped)

    def _hear_tf(self, message: Any) -> None:
        for one in map(stamped_transform, message.transforms):
            if one.parent == "map" and one.child != "odom":
                self.heard.others.append((one.child, one.t_ns, pose_of_transform(one)))
            elif one.parent == "map":
                self.heard.transforms.append((time.time_ns(), one.t_ns, pose_of_transform(one)))

    def _hear_pose(self, message: Any) -> None:
        pose = pose_of_transform(stamped_transform(message))
        self.heard.poses.append((time.time_ns(), stamp_ns(message.header.stamp), pose))

    def _hear_status(self, message: Any) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            self.heard.statuses.append((time.time_ns(), status.level, status.message, values))


@contextmanager
def followed(
    topomap: Path, domain: int, *options: str, stdout: Any = subprocess.DEVNULL
) -> Iterator[subprocess.Popen[str]]:
    """Run `topoloc follow MAP ros:/camera/image_raw --ros` in its own process, as a
    user types it."""
    command = [sys.executable, "-m", "topoloc", "follow", str(topomap), f"ros:{IMAGE_TOPIC}"]
    environment = os.environ | {"ROS_DOMAIN_ID": str(domain)}
    with subprocess.Popen(
        [*command, *options],
        stdout=stdout,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def _drifted(motion: Rigid3) -> Rigid3:
    """Return the motion of a camera as odometry measures it, with rotation about the robot's z."""
    base_motion = BASE_FROM_CAM @ motion @ BASE_FROM_CAM.inverse()
    way = float(np.linalg.norm(base_motion.translation))
    turn = exp_so3(np.array([0.0, 0.0, TURN_PER_METRE * way]))
    measured = Rigid3(base_motion.rotation @ turn, (1.0 + SCALE_ERROR) * base_motion.translation)
    return BASE_FROM_CAM.inverse() @ measured @ BASE_FROM_CAM


def _sleep_until(t_ns: int) -> None:
    time.sleep(max((t_ns - time.time_ns()) / 1e9, 0.0))
