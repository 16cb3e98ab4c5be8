"""Test the ROS package: its files, its parameters, and its node with stand-ins for the
classes of rclpy."""

from __future__ import annotations

import ast
import importlib
import runpy
import sys
import time
import types
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import fields
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from tiny_world import CAMERA, path_pose, render, room
from topoloc.apps.robots.config import RobotConfig
from topoloc.apps.robots.robot_localizer import RobotLocalizer
from topoloc.apps.robots.ros_node import RobotPublisher
from topoloc.errors import ConfigError
from topoloc.geometry.rigid import Rigid3

yaml = pytest.importorskip("yaml")
PACKAGE = Path(__file__).parents[3] / "ros" / "topoloc_ros"


@pytest.fixture
def parameters(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    monkeypatch.syspath_prepend(str(PACKAGE))
    yield importlib.import_module("topoloc_ros.parameters")
    for name in [one for one in sys.modules if one.startswith("topoloc_ros")]:
        del sys.modules[name]


def test_installed_files_exist(monkeypatch: pytest.MonkeyPatch):
    given: dict[str, Any] = {}
    monkeypatch.setattr("setuptools.setup", lambda **settings: given.update(settings))
    monkeypatch.chdir(PACKAGE)
    runpy.run_path("setup.py")
    assert all(Path(file).is_file() for _, files in given["data_files"] for file in files)
    installed = {Path(file).suffix for _, files in given["data_files"] for file in files}
    assert {".xml", ".yaml", ".rviz", ".py"} <= installed
    (command,) = given["entry_points"]["console_scripts"]
    name, _, place = command.partition(" = ")
    launch = (PACKAGE / "launch" / "localize.launch.py").read_text(encoding="utf-8")
    assert f'executable="{name}"' in launch
    module, _, function = place.partition(":")
    tree = ast.parse((PACKAGE / f"{module.replace('.', '/')}.py").read_text(encoding="utf-8"))
    assert function in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_imported_packages_are_dependencies():
    root = ElementTree.parse(PACKAGE / "package.xml").getroot()
    assert root.findtext("name") == PACKAGE.name
    depends = {one.text for one in root.iter("exec_depend")}
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module and not node.level:
                top = node.module.partition(".")[0]
                is_ros = top.endswith(("_msgs", "interfaces")) or top.startswith(("rcl", "launch"))
                assert not is_ros or top in depends, f"{path.name}: {top}"


def test_the_parameters_of_the_file_are_settings(parameters: Any):
    data = yaml.safe_load((PACKAGE / "config" / "topoloc.yaml").read_text(encoding="utf-8"))
    config = parameters.robot_config(data["topoloc"]["ros__parameters"])
    assert config.planar
    assert (config.odom_frame, config.domain) == ("odom", 0)


def test_wrong_parameters_are_named(parameters: Any):
    assert parameters.robot_config({"use_sim_time": True}).use_sim_time
    with pytest.raises(ConfigError, match="parameter planar: "):
        parameters.robot_config({"planar": 0.5})
    with pytest.raises(ConfigError, match="parameter odom: topoloc_ros has no such parameter"):
        parameters.robot_config({"odom": "wheels"})


def test_nav2_gets_no_second_localizer():
    data = yaml.safe_load((PACKAGE / "config" / "nav2_params.yaml").read_text(encoding="utf-8"))
    assert "amcl" not in data
    assert data["lifecycle_manager_localization"]["ros__parameters"]["node_names"] == ["map_server"]
    frames = RobotConfig()
    costmap = data["global_costmap"]["global_costmap"]["ros__parameters"]
    assert costmap["global_frame"] == frames.map_frame
    assert costmap["robot_base_frame"] == frames.base_frame
    assert costmap["transform_tolerance"] > RobotLocalizer.transform_tolerance


def test_rviz_shows_the_pose_and_sets_the_initial_one():
    data = yaml.safe_load((PACKAGE / "rviz" / "topoloc.rviz").read_text(encoding="utf-8"))
    manager = data["Visualization Manager"]
    topics = {one["Topic"]["Value"] for one in manager["Displays"] if "Topic" in one}
    assert "/topoloc/pose" in topics
    tools = {one["Class"]: one for one in manager["Tools"]}
    assert tools["rviz_default_plugins/SetInitialPose"]["Topic"]["Value"] == "/initialpose"


class Topics:
    """Stand in for a node of rclpy and store the published messages. `heard` has the callbacks of
    its subscriptions."""

    def __init__(self, name: str = "topoloc") -> None:
        self.sent: dict[str, list[Any]] = {}
        self.publishers: list[Any] = []
        self.heard: dict[str, Callable[[Any], None]] = {}
        self.context = types.SimpleNamespace(get_domain_id=lambda: 7)

    def create_publisher(self, kind: Any, name: str, depth: int) -> Any:
        self.publishers.append(types.SimpleNamespace(publish=self.sent.setdefault(name, []).append))
        return self.publishers[-1]

    def create_subscription(self, kind: Any, name: str, callback: Any, profile: Any) -> str:
        self.heard[name] = callback
        return name

    def destroy_publisher(self, publisher: Any) -> None:
        self.publishers.remove(publisher)

    def destroy_subscription(self, name: str) -> None:
        del self.heard[name]


SUCCESS, FAILURE = "success", "failure"


class Lifecycle(Topics):
    """Stand in for a lifecycle node of rclpy: its parameters, its log and its transitions, which
    pass the state before. `given` are parameters of a launch file."""

    given: ClassVar[dict[str, Any]] = {}

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.values: dict[str, Any] = {"use_sim_time": False}
        self.lines: list[str] = []
        self.state = "unconfigured"

    def declare_parameter(self, name: str, value: Any) -> Any:
        self.values[name] = self.given.get(name, value)
        return self.get_parameter(name)

    def get_parameter(self, name: str) -> Any:
        return types.SimpleNamespace(value=self.values[name])

    def get_logger(self) -> Any:
        add = self.lines.append
        return types.SimpleNamespace(warning=add, error=add, fatal=add)

    def trigger(self, name: str, after: str) -> str:
        result = getattr(self, f"on_{name}")(types.SimpleNamespace(label=self.state))
        self.state = after if result == SUCCESS else self.state
        return result

    def trigger_configure(self) -> str:
        return self.trigger("configure", "inactive")

    def trigger_activate(self) -> str:
        return self.trigger("activate", "active")


def _message_class(kind: Any) -> type:
    """Return a class as rosidl generates it: fields by name only, and octets as bytes."""
    names = [one.name for one in fields(kind)]
    octets = {"level"} if kind.__name__ == "DiagnosticStatus" else set()

    class Message:
        @classmethod
        def get_fields_and_field_types(cls) -> dict[str, str]:
            return {name: "octet" if name in octets else "other" for name in names}

        def __init__(self, **values: Any) -> None:
            assert set(values) == set(names)
            assert all(isinstance(values[name], bytes) for name in octets)
            self.__dict__.update(values)

    Message.__name__ = kind.__name__
    return Message


@pytest.fixture
def node_module(parameters: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    pytest.importorskip("cyclonedds", reason="the extra ros is not installed")
    from topoloc.apps.robots import ros_messages

    def fake(name: str, **members: Any) -> None:
        module = types.ModuleType(name)
        module.__dict__.update(members)
        monkeypatch.setitem(sys.modules, name, module)

    by_name = {
        one.__name__: _message_class(one)
        for one in vars(ros_messages).values()
        if isinstance(one, type) and issubclass(one, ros_messages.IdlStruct) and fields_of(one)
    }
    policy = types.SimpleNamespace(BEST_EFFORT=1, TRANSIENT_LOCAL=2)
    fake("rclpy", __path__=[], init=lambda: None, try_shutdown=lambda: None)
    codes = types.SimpleNamespace(SUCCESS=SUCCESS, FAILURE=FAILURE)
    lifecycle = {"LifecycleNode": Lifecycle, "State": object, "TransitionCallbackReturn": codes}
    fake("rclpy.lifecycle", **lifecycle)
    fake("rclpy.task", Future=Future)
    fake("rclpy.executors", ExternalShutdownException=KeyboardInterrupt)
    profile = types.SimpleNamespace
    fake("rclpy.qos", DurabilityPolicy=policy, QoSProfile=profile, ReliabilityPolicy=policy)
    for package in (
        *("builtin_interfaces", "diagnostic_msgs", "geometry_msgs", "rosgraph_msgs"),
        *("sensor_msgs", "std_msgs", "tf2_msgs"),
    ):
        fake(package, __path__=[])
        fake(f"{package}.msg", **by_name)
    return importlib.import_module("topoloc_ros.node")


def fields_of(kind: type) -> tuple[Any, ...]:
    return fields(kind) if hasattr(kind, "__dataclass_fields__") else ()


def test_the_node_publishes_messages_of_rclpy(node_module: Any):
    topics = Topics()
    publisher = RobotPublisher(node_module.RclpyNode(topics), RobotConfig())
    pose = Rigid3.exp(np.array([1.0, 2.0, 3.0, 0.1, -0.2, 0.3]))
    publisher.send_pose(7_000_000_009, pose, np.eye(6))
    publisher.send_transform(7_000_000_009, "odom", pose)
    publisher.send_status(7_000_000_009, 2, "lost", {"state": "lost"})
    (sent,), (tf,) = topics.sent["topoloc/pose"], topics.sent["/tf"]
    assert (sent.header.stamp.sec, sent.header.stamp.nanosec) == (7, 9)
    assert sent.pose.pose.position.x == pose.translation[0]
    assert len(sent.pose.covariance) == 36
    assert tf.transforms[0].transform.rotation.w == pose.quat_wxyz()[0]
    (array,) = topics.sent["/diagnostics"]
    assert array.status[0].level == b"\x02"


def test_the_node_keeps_the_newest_messages(node_module: Any):
    topics = Topics()
    node = node_module.RclpyNode(topics)
    reader = node.create_reader("/image", node.messages.Image, "sensor")
    for number in range(8):
        topics.heard["/image"](number)
    assert reader.take(5) == [3, 4, 5, 6, 7]
    assert reader.take(5) == []
    assert node.domain == 7


def test_an_initial_pose_is_published_once(node_module: Any):
    topics, config = Topics(), RobotConfig(publish_initial_pose=True)
    publisher = RobotPublisher(node_module.RclpyNode(topics), config)
    for number in range(3):
        publisher.send_pose(number, Rigid3.identity(), np.eye(6))
    (initial,) = topics.sent["initialpose"]
    assert initial is topics.sent["topoloc/pose"][0]


@pytest.fixture
def localizer_node(
    node_module: Any, room_map: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., Any]]:
    """Return a function that makes a node of the room's map with more parameters."""
    camera = f"{CAMERA.fx},{CAMERA.fy},{CAMERA.cx},{CAMERA.cy}"
    module, nodes = importlib.import_module("topoloc_ros.lifecycle_node"), list[Any]()

    def make(**given: Any) -> Any:
        parameters = {"map": str(room_map), "camera": camera, "odom_frame": "none", **given}
        monkeypatch.setattr(Lifecycle, "given", parameters)
        nodes.append(module.LocalizerNode())
        return nodes[-1]

    yield make
    for node in nodes:
        node.end()


def _show(node: Any, is_enough: Callable[[], bool], hz: float = 10.0) -> dict[int, Rigid3]:
    """Send images of a drive through the room until a condition is true. Return their poses by
    time."""
    from topoloc.apps.robots import ros_messages as ros

    start, shown = time.time_ns(), dict[int, Rigid3]()
    for number in range(300):
        t_ns, pose = start + round(number * 1e9 / hz), path_pose(1.0 + 0.02 * number)
        pixels, shown[t_ns] = render(room(), pose, noise_seed=number)[0], pose
        header = ros.Header(ros.Time(*divmod(t_ns, 1_000_000_000)), "camera")
        height, width = pixels.shape
        layout = (height, width, "mono8", 0, width, pixels.tobytes())
        node.heard["/camera/image_raw"](ros.Image(header, *layout))
        end = time.monotonic() + 1.0 / hz
        while time.monotonic() < end:
            if is_enough():
                return shown
            time.sleep(0.01)
    pytest.fail(f"nothing in 30 s: {node.lines}")


def test_the_lifecycle_node_localizes_while_it_is_active(localizer_node: Any):
    node = localizer_node()
    assert node.trigger_configure() == SUCCESS
    assert (node.heard, node.publishers) == ({}, [])
    for _ in range(2):  # it can be activated again
        assert node.trigger_activate() == SUCCESS
        sent = node.sent["topoloc/pose"]
        sent.clear()
        shown = _show(node, lambda sent=sent: len(sent) > 0)
        stamp, position = sent[0].header.stamp, sent[0].pose.pose.position
        truth = shown[stamp.sec * 1_000_000_000 + stamp.nanosec].translation
        assert np.linalg.norm(truth - [position.x, position.y, position.z]) < 0.05
        assert node.trigger("deactivate", "inactive") == SUCCESS
        assert (node.heard, node.publishers) == ({}, [])
    assert node.trigger("cleanup", "unconfigured") == SUCCESS
    assert not node.failed.done()


def test_a_node_without_its_map_stays_unconfigured(localizer_node: Any, room_map: Path):
    node = localizer_node(map="none.topo")
    assert node.trigger_configure() == FAILURE
    assert (node.state, len(node.lines)) == ("unconfigured", 1)
    assert "none.topo" in node.lines[0]
    node.values["map"] = str(room_map)
    assert node.trigger_configure() == SUCCESS


def test_a_topic_that_is_none_refuses_activation(localizer_node: Any):
    node = localizer_node(image="/camera image")
    assert node.trigger_configure() == SUCCESS
    assert node.trigger_activate() == FAILURE
    assert "no topic of ROS" in node.lines[0]
    assert (node.heard, node.publishers) == ({}, [])


def test_an_uncalibrated_camera_ends_the_process(localizer_node: Any, monkeypatch: Any):
    """A launch file starts it again."""
    from topoloc.apps.robots import ros_messages as ros

    zeros: Any = [0.0] * 12
    no_distortion: Any = []
    header, roi = ros.Header(ros.Time(1, 0), "camera"), ros.RegionOfInterest(0, 0, 0, 0, False)
    size = (CAMERA.height, CAMERA.width)
    matrices = (zeros[:9], zeros[:9], zeros)
    info = ros.CameraInfo(header, *size, "plumb_bob", no_distortion, *matrices, 0, 0, roi)

    def spin(node: Any, future: Future[None]) -> None:
        assert node.state == "active"
        node.heard["/camera/camera_info"](info)
        _show(node, future.done)

    module = importlib.import_module("topoloc_ros.lifecycle_node")
    node = localizer_node(camera="")
    monkeypatch.setattr(module.rclpy, "spin_until_future_complete", spin, raising=False)
    monkeypatch.setattr(module, "LocalizerNode", lambda: node)
    with pytest.raises(SystemExit) as ended:
        module.main()
    assert ended.value.code == 1
    assert "K is zero" in node.lines[-1]


@pytest.mark.parametrize("simulated", [False, True])
def test_simulated_is_a_parameter(localizer_node: Any, simulated: bool, monkeypatch: Any):
    module, configs = importlib.import_module("topoloc_ros.lifecycle_node"), list[Any]()
    tracker = module.Tracker

    def track(localizer: Any, config: Any) -> Any:
        configs.append(config)
        return tracker(localizer, config)

    monkeypatch.setattr(module, "Tracker", track)
    node = localizer_node(simulated=simulated)
    assert (node.trigger_configure(), node.trigger_activate()) == (SUCCESS, SUCCESS)
    assert [one.simulated for one in configs] == [simulated]
