"""Test the messages that a robot's localizer publishes for a stream, without a network."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from topoloc.apps.cli.queries.query_answers import QueryAnswer, QueryFrame
from topoloc.apps.robots import robot_localizer
from topoloc.apps.robots.config import RobotConfig
from topoloc.apps.robots.robot_localizer import RobotLocalizer
from topoloc.apps.robots.ros_node import RobotPublisher, RosNode
from topoloc.errors import MapError
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.provenance import Provenance
from topoloc.localization.result import Localization, NotLocalized
from topoloc.node_ids import NodeId
from topoloc.recordings.frame import StereoFrame
from topoloc.tracking.stream_result import StreamedPose
from topoloc.tracking.tracker import Tracker

COVARIANCE = 1e-4 * np.eye(6)
MAP_FROM_ODOM = Rigid3.exp(np.array([1.0, -2.0, 0.0, 0.0, 0.0, 0.4]))
BASE_FROM_CAM = Rigid3.exp(np.array([0.2, 0.0, 0.5, -1.57, 0.0, 0.0]))


class Publisher(RobotPublisher):
    """Store the published messages."""

    def __init__(self, node: Any, config: RobotConfig) -> None:
        self.poses: list[tuple[int, Rigid3]] = []
        self.transforms: list[tuple[int, str, Rigid3]] = []
        self.statuses: list[tuple[int, str, dict[str, str]]] = []
        node.publisher = self

    def send_pose(self, t_ns: int, pose: Rigid3, covariance: np.ndarray) -> None:
        self.poses.append((t_ns, pose))

    def send_transform(self, t_ns: int, child: str, map_from_child: Rigid3) -> None:
        self.transforms.append((t_ns, child, map_from_child))

    def send_status(self, t_ns: int, level: int, text: str, values: dict[str, str]) -> None:
        self.statuses.append((level, text, values))


class Node(RosNode):
    """Store the callbacks of the topics."""

    publisher: Publisher

    def __init__(self) -> None:
        self.heard: dict[str, Callable[[Any], None]] = {}
        self.messages = SimpleNamespace(
            PoseWithCovarianceStamped=None, TFMessage=None, Clock=None, Image=None
        )

    def create_reader(self, name: str, kind: Any, quality: str, callback: Any = None) -> Any:
        self.heard[name] = callback

    def start(self) -> None:
        pass

    def tf(self, t_ns: int, parent: str, child: str, pose: Rigid3, is_static: bool = False) -> None:
        stamped = _message(t_ns, parent, pose, child)
        self.heard["/tf_static" if is_static else "/tf"](SimpleNamespace(transforms=[stamped]))


def _message(t_ns: int, parent: str, pose: Rigid3, child: str = "") -> SimpleNamespace:
    w, x, y, z = pose.quat_wxyz().tolist()
    place = SimpleNamespace(**dict(zip("xyz", pose.translation.tolist(), strict=True)))
    moved = SimpleNamespace(translation=place, rotation=SimpleNamespace(x=x, y=y, z=z, w=w))
    stamp = SimpleNamespace(sec=t_ns // 10**9, nanosec=t_ns % 10**9)
    header = SimpleNamespace(stamp=stamp, frame_id=parent)
    return SimpleNamespace(header=header, child_frame_id=child, transform=moved)


class Robot:
    """Hold a localizer, its inputs and its messages. The robot drives 0.5 m/s."""

    def __init__(self, config: RobotConfig, map_from_world: Rigid3 | None = None) -> None:
        self.warnings: list[str] = []
        self.node: Any = Node()
        self.localizer = RobotLocalizer(
            self.node, config, None, self.warnings.append, map_from_world
        )
        self.world_from_map = (map_from_world or Rigid3.identity()).inverse()
        self.published: Publisher = self.node.publisher
        self.start_ns, self.has_tf = time.time_ns(), config.has_odometry
        self.expected: list[Rigid3] = []
        if self.has_tf:
            self.node.tf(0, "base_link", "topoloc_camera", BASE_FROM_CAM, is_static=True)

    def base(self, number: int) -> Rigid3:
        """Return odom_from_base at an image."""
        return Rigid3.exp(np.array([0.05 * number, 0.0, 0.0, 0.0, 0.0, 0.01 * number]))

    def see(self, number: int, **changes: Any) -> None:
        """Process an image with the right pose, except for the given changes."""
        t_ns = self.start_ns + 100_000_000 * number
        if self.has_tf:
            self.node.tf(t_ns, "odom", "base_link", self.base(number))
        pose = self.world_from_map @ MAP_FROM_ODOM @ self.base(number) @ BASE_FROM_CAM
        pose = changes.pop("wrong", Rigid3.identity()) @ pose
        probability = changes.pop("probability", 1.0)
        result = Localization(pose, COVARIANCE, probability, NodeId(1), [], 0, 0, {})
        answer = StreamedPose(t_ns, "localized", result, pose, COVARIANCE)
        answer = replace(answer, **changes)

        frame = _Frame(f"{number}", t_ns, _unread, answer=answer)
        self.localizer.localize(frame, _Expecting(self.expected), None)


def _unread() -> StereoFrame:
    raise NotImplementedError


@dataclass(frozen=True, eq=False)
class _Frame(QueryFrame):
    answer: Any = None

    def localize(self, cameras: Any, tracker: Any, camera_of_size: Any) -> QueryAnswer:
        return QueryAnswer(self.name, self.t_ns, self.answer.result, self.answer)


class _Expecting(Tracker):
    """Store the priors that the tracker gets."""

    def __init__(self, expected: list[Rigid3]) -> None:
        self.expected, self.cameras = expected, cast(Any, None)

    def expect(
        self,
        world_from_cam: Rigid3,
        covariance: np.ndarray,
        t_ns: int,
        odom_from_cam: Rigid3 | None = None,
    ) -> None:
        assert np.linalg.eigvalsh(covariance).min() > 0.0
        self.expected.append(world_from_cam)

    def reset(self) -> None:
        self.expected.clear()


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(robot_localizer, "RobotPublisher", Publisher)
    robots = list[Robot]()

    def make_robot(map_from_world: Rigid3 | None = None, **settings: Any) -> Robot:
        robots.append(Robot(RobotConfig(**settings), map_from_world))
        return robots[-1]

    yield make_robot
    for robot in robots:
        robot.localizer.close()


def test_map_to_odom_is_that_of_the_measured_poses(make: Callable[..., Robot]):
    """The axes of the world differ from the axes of the robot's map."""
    robot = make(Rigid3.exp(np.array([3.0, 0.0, 1.0, 1.0, 0.5, 0.0])))
    for number in range(5):
        robot.see(number)
    t_ns, child, pose = robot.published.transforms[-1]
    assert child == "odom"
    assert np.allclose(pose.matrix(), MAP_FROM_ODOM.matrix(), atol=1e-9)
    assert 0.0 < (t_ns - time.time_ns()) / 1e9 <= 0.2  # ahead
    poses = [pose for _, pose in robot.published.poses]
    assert len(poses) == 3  # the third agreeing pose, and later ones
    expected = MAP_FROM_ODOM @ robot.base(4)
    assert np.allclose(poses[-1].matrix(), expected.matrix(), atol=1e-9)
    assert robot.warnings == []


def test_a_map_without_scale_publishes_no_metres(make: Callable[..., Robot]):
    robot = make()
    pose = MAP_FROM_ODOM @ BASE_FROM_CAM
    unscaled = Provenance("0123456789abcdef", has_scale=False)
    result = Localization(pose, COVARIANCE, 1.0, NodeId(1), [], 0, 0, {}, provenance=unscaled)
    for number in range(4):
        with pytest.raises(MapError, match=r"abcdef has no scale, but a robot needs metres"):
            robot.see(number, result=result)
    assert robot.published.transforms == []
    assert robot.published.poses == []


def test_it_is_published_between_the_images_with_stamps_that_increase(make: Callable[..., Robot]):
    robot = make()
    for number in range(4):
        robot.see(number)
    time.sleep(0.8)
    stamps = [t_ns for t_ns, _, _ in robot.published.transforms]
    assert len(stamps) > 15
    assert np.diff(stamps).min() > 0


def test_poses_without_evidence_are_not_published(make: Callable[..., Robot]):
    """The gate ignores predicted poses, low probabilities, repeated images and tracked points at
    another place."""
    robot = make()
    for number in range(5):
        robot.see(number)
    shown = len(robot.published.poses)
    away = Rigid3.exp(np.array([0.0, 2.0, 0.0, 0.0, 0.0, 0.0]))
    refused = NotLocalized("too_few_matches")
    for number in range(5, 60, 4):
        robot.see(number, state="predicted", result=refused)
        robot.see(number + 1, probability=0.5, wrong=away)
        robot.see(number + 2, is_repeated=True, wrong=away)
        robot.see(number + 3, state="tracked", wrong=away)
    assert len(robot.published.poses) == shown
    assert np.allclose(robot.published.transforms[-1][2].matrix(), MAP_FROM_ODOM.matrix())
    robot.see(62, is_repeated=True, is_confirmed=True)  # the robot stands
    assert len(robot.published.poses) == shown + 1


def test_the_gate_holds_after_images_without_tf(make: Callable[..., Robot]):
    robot = make()
    for number in range(40):
        robot.see(number)
    robot.has_tf = False
    robot.see(40)
    robot.has_tf = True
    shown = len(robot.published.poses)
    away = Rigid3.exp(np.array([0.0, 0.5, 0.0, 0.0, 0.0, 0.0]))
    robot.see(41, wrong=away)
    assert len(robot.published.poses) == shown
    robot.see(42)
    assert len(robot.published.poses) == shown + 1


def test_a_plane_is_a_plane(make: Callable[..., Robot]):
    robot = make(planar=True)
    tilted = Rigid3.exp(np.array([0.0, 0.0, 0.1, 0.01, -0.02, 0.0]))
    for number in range(4):
        robot.see(number, wrong=tilted)
    for pose in (robot.published.poses[-1][1], robot.published.transforms[-1][2]):
        assert pose.translation[2] == 0.0
        assert pose.rotation[2].tolist() == [0.0, 0.0, 1.0]
    assert robot.warnings == []


def test_a_map_that_lies_on_its_side_has_no_plane(make: Callable[..., Robot]):
    robot = make(planar=True)
    side = Rigid3.exp(np.array([0.0, 0.0, 0.0, 1.5, 0.0, 0.0]))
    for number in range(4):
        robot.see(number, wrong=side)
    (line,) = robot.warnings
    assert "tilted by 86 degrees in the map; --planar needs a map whose z axis points up" in line


def test_missing_tf_is_one_warning_and_an_error_of_diagnostics(make: Callable[..., Robot]):
    robot = make(base_frame="base_footprint")
    for number in range(4):
        robot.see(number)
    assert robot.warnings == []  # it may be starting
    time.sleep(robot.localizer.patience)
    robot.see(4)
    (line,) = robot.warnings
    assert "no frame base_footprint in TF" in line
    assert robot.published.poses == []
    time.sleep(1.2)  # one more status
    level, text, values = robot.published.statuses[-1]
    assert (level, text, values["state"]) == (2, line, "localized")


@pytest.mark.parametrize("height", [0.0, float("nan"), float("inf"), -1.0])
def test_a_pose_of_the_user_is_a_prior(make: Callable[..., Robot], height: float):
    """The tool may fill the variance of unknown components with any value."""
    world = Rigid3.exp(np.array([3.0, 0.0, 1.0, 1.0, 0.5, 0.0]))
    robot = make(world)
    given = MAP_FROM_ODOM @ robot.base(0)
    message = _message(robot.start_ns, "map", given)
    message.pose = SimpleNamespace(
        pose=SimpleNamespace(
            position=message.transform.translation, orientation=message.transform.rotation
        ),
        covariance=np.diag([0.25, 0.25, height, 0.0, 0.0, 0.07]).ravel().tolist(),
    )
    del message.transform
    robot.node.heard["initialpose"](message)
    robot.see(0)
    assert len(robot.published.poses) == 1  # one image that agrees is enough
    (prior,) = robot.expected
    expected = world.inverse() @ given @ BASE_FROM_CAM
    assert np.allclose(prior.matrix(), expected.matrix(), atol=1e-9)
    robot.see(1)
    assert len(robot.expected) == 1
    message.header.frame_id = "odom"
    robot.node.heard["initialpose"](message)
    assert robot.warnings == ["a pose on /initialpose is ignored: it is in odom, not map"]


def test_the_stamps_of_another_clock_are_used_and_reported(make: Callable[..., Robot]):
    robot = make()
    robot.start_ns -= 5_000_000_000
    for number in range(20):
        robot.see(number)
    (line,) = robot.warnings
    assert "s behind this clock; synchronize the machines (chrony), or set use_sim_time" in line
    ahead = (robot.published.transforms[-1][0] - robot.start_ns) / 1e9
    assert ahead < 4.0


def test_simulated_time_stamps_the_transforms(make: Callable[..., Robot]):
    robot = make(use_sim_time=True)
    robot.start_ns = 1_000_000_000
    clock = robot.node.heard["/clock"]
    t_ns = 0
    for number in range(12):
        t_ns = robot.start_ns + 100_000_000 * number
        clock(SimpleNamespace(clock=SimpleNamespace(sec=t_ns // 10**9, nanosec=t_ns % 10**9)))
        robot.see(number)
    assert robot.published.transforms[-1][0] == t_ns + 200_000_000
    time.sleep(0.2)
    stamps = [t_ns for t_ns, _, _ in robot.published.transforms]
    assert len(stamps) == len(set(stamps))  # time stands still, and nothing is repeated
    assert robot.warnings == []


def test_a_clock_that_is_set_back_starts_again(make: Callable[..., Robot]):
    robot = make(use_sim_time=True)
    robot.node.heard["/clock"](SimpleNamespace(clock=SimpleNamespace(sec=99, nanosec=0)))
    for start in (50, 10):
        robot.start_ns = start * 1_000_000_000
        robot.published.poses.clear()
        for number in range(4):
            robot.see(number)
        assert len(robot.published.poses) == 2


def test_another_localizer_is_named(make: Callable[..., Robot]):
    robot = make()
    robot.node.tf(robot.start_ns, "map", "odom", MAP_FROM_ODOM)
    robot.see(0)
    assert robot.warnings == ["another node publishes TF to odom; stop it, or name the frames"]


def test_after_a_kidnapping_it_moves_at_once(make: Callable[..., Robot]):
    robot = make()
    for number in range(4):
        robot.see(number)
    away = Rigid3.exp(np.array([0.0, 2.0, 0.0, 0.0, 0.0, 0.0]))
    for number in range(4, 16):
        robot.see(number, wrong=away)
    _, _, pose = robot.published.transforms[-1]
    moved = np.linalg.norm(pose.translation - MAP_FROM_ODOM.translation)
    assert moved == pytest.approx(2.0)
    time.sleep(0.3)
    later = robot.published.transforms[-1][2]
    assert np.linalg.norm(later.translation - MAP_FROM_ODOM.translation) == pytest.approx(moved)
    level, text, values = robot.published.statuses[-1]
    assert (level, text, values["jumps"]) == (0, "localized", "1")


def test_without_odometry_each_measured_pose_is_that_of_the_camera(make: Callable[..., Robot]):
    robot = make(odom_frame="none", camera_frame="front")
    robot.start_ns = 5_000_000_000  # of a recording
    for number in range(3):
        robot.see(number)
    robot.see(3, state="predicted", result=NotLocalized("too_few_matches"))
    (t_ns, child, pose) = robot.published.transforms[0]
    assert (t_ns, child, len(robot.published.poses)) == (5_200_000_000, "front", 1)
    expected = MAP_FROM_ODOM @ robot.base(2) @ BASE_FROM_CAM
    assert np.allclose(pose.matrix(), expected.matrix(), atol=1e-9)
    assert "/tf" not in robot.node.heard
    for number in range(4, 9):
        robot.see(number)
    assert robot.warnings == []


def test_without_odometry_a_jump_is_published_once_three_images_agree(make: Callable[..., Robot]):
    robot, num_published = make(odom_frame="none"), list[int]()
    away = Rigid3.exp(np.array([0.0, 20.0, 0.0, 0.0, 0.0, 0.0]))
    for number, is_away in enumerate([False] * 4 + [True] + [False] + [True] * 3):
        robot.see(number, **({"wrong": away} if is_away else {}))
        num_published.append(len(robot.published.poses))
    assert num_published == [0, 0, 1, 2, 2, 3, 3, 3, 4]


def test_an_initial_pose_is_published_or_received(make: Callable[..., Robot]):
    assert "initialpose" in make().node.heard
    assert "initialpose" not in make(publish_initial_pose=True).node.heard
