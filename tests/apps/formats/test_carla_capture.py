"""Test recording from CARLA: axes as in its client's transforms, and a route with a
stand-in server."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from topoloc.apps.formats.carla import (
    CarlaConfig,
    carla_camera,
    carla_client,
    carla_frames,
    world_from_carla_transform,
)
from topoloc.apps.formats.recording_writer import RecordingWriter
from topoloc.errors import ConfigError, RecordingError
from topoloc.recordings.open import open_sequence

carla: Any = pytest.importorskip("carla", reason="CARLA's client (extra carla) is not installed")


def ours(vector: Any) -> np.ndarray:
    """Convert a vector from CARLA's world axes to ours."""
    return np.array([vector.x, -vector.y, vector.z])


@pytest.mark.parametrize(
    "angles", [(0, 0, 0), (0, 90, 0), (10, 30, 5), (-35, 200, -60), (80, -170, 179)]
)
def test_axes_are_those_of_the_client(angles: tuple[float, float, float]):
    pitch, yaw, roll = map(float, angles)
    transform = carla.Transform(
        carla.Location(3.0, 5.0, 7.0), carla.Rotation(pitch=pitch, yaw=yaw, roll=roll)
    )
    pose = world_from_carla_transform(transform)
    np.testing.assert_allclose(pose.translation, [3.0, -5.0, 7.0], atol=1e-5)
    right, down, forward = pose.rotation.T
    np.testing.assert_allclose(forward, ours(transform.get_forward_vector()), atol=1e-5)
    np.testing.assert_allclose(right, ours(transform.get_right_vector()), atol=1e-5)
    np.testing.assert_allclose(down, -ours(transform.get_up_vector()), atol=1e-5)
    assert np.linalg.det(pose.rotation) == pytest.approx(1.0)


def test_points_in_front_of_a_camera_are_where_carla_has_them():
    """`carla.Transform` maps a point from the camera frame (forward, right, up) to the world."""
    transform = carla.Transform(
        carla.Location(-20.0, 4.0, 1.6), carla.Rotation(pitch=-4.0, yaw=135.0, roll=2.0)
    )
    point_world = transform.transform(carla.Location(10.0, 2.0, -1.0))
    np.testing.assert_allclose(
        world_from_carla_transform(transform).inverse().apply(ours(point_world)),
        [2.0, 1.0, 10.0],
        atol=1e-4,
    )


class StandInSensor:
    """Render images whose blue is the sensor number, green the step, and red the x of its place."""

    def __init__(self, number: int) -> None:
        self.number, self.listener, self.transform, self.ended = number, None, carla.Transform(), []

    def listen(self, listener: Callable[[Any], None]) -> None:
        self.listener = listener

    def set_transform(self, transform: Any) -> None:
        self.transform = transform

    def stop(self) -> None:
        self.ended.append("stop")

    def destroy(self) -> None:
        self.ended.append("destroy")


class StandInWorld:
    """Simulate a lane along CARLA's y: straight on at a junction after 5 m, with an
    end after 9 m."""

    def __init__(self, num_silent: int = 10**6, late: int = 0) -> None:
        self.sensors: list[StandInSensor] = []
        self.settings, self.weather, self.blueprints = (
            SimpleNamespace(synchronous_mode=False, fixed_delta_seconds=None),
            None,
            [],
        )
        self.step, self.num_silent, self.late = itertools.count(100), num_silent, late

    def get_settings(self) -> SimpleNamespace:
        return SimpleNamespace(**vars(self.settings))

    def apply_settings(self, settings: SimpleNamespace) -> None:
        self.settings = settings

    def set_weather(self, weather: Any) -> None:
        self.weather = weather

    def get_blueprint_library(self) -> SimpleNamespace:
        def find(name: str) -> SimpleNamespace:
            values: dict[str, str] = {"name": name}
            self.blueprints.append(values)
            return SimpleNamespace(
                has_attribute=lambda key: key != "lens_k" or "rgb" in name,
                set_attribute=values.__setitem__,
            )

        return SimpleNamespace(find=find)

    def spawn_actor(self, blueprint: Any, transform: Any) -> StandInSensor:
        self.sensors.append(StandInSensor(len(self.sensors)))
        return self.sensors[-1]

    def tick(self) -> int:
        step = next(self.step)
        for sensor in self.sensors:
            pixels = np.full(
                (6, 8, 4),
                (sensor.number, step % 256, round(sensor.transform.location.x) % 256, 255),
                np.uint8,
            )
            if sensor.number == 2:
                pixels[0, 0] = 255  # sky
            shown = SimpleNamespace(
                frame=step + self.late, timestamp=0.1 * step, transform=sensor.transform
            )
            shown.raw_data, shown.width, shown.height = pixels.tobytes(), 8, 6
            if step < self.num_silent and sensor.listener is not None:
                sensor.listener(shown)
        return step

    def get_map(self) -> SimpleNamespace:
        start = carla.Transform(carla.Location(60.0, 0.0, 0.2), carla.Rotation(yaw=90.0))
        return SimpleNamespace(
            name="Town00",
            get_spawn_points=lambda: [start],
            get_waypoint=lambda _: self.waypoint(0.0),
        )

    def waypoint(self, y: float, yaw: float = 90.0) -> SimpleNamespace:
        def following(metres: float) -> list[SimpleNamespace]:
            ahead = y + metres
            at_junction = [
                self.waypoint(ahead, 0.0),
                self.waypoint(ahead),
                self.waypoint(ahead, 180.0),
            ]
            return [] if ahead > 9.0 else at_junction if ahead == 5.0 else [self.waypoint(ahead)]

        transform = carla.Transform(carla.Location(60.0, y, 0.2), carla.Rotation(yaw=yaw))
        return SimpleNamespace(transform=transform, next=following)


CONFIG = CarlaConfig(
    length=100.0,
    spacing=1.0,
    lane_offset=2.0,
    weather="rain",
)
SIZE = (8, 6)


def client_of(world: StandInWorld) -> SimpleNamespace:
    return SimpleNamespace(get_world=lambda: world)


def test_a_route_is_recorded(tmp_path: Path):
    world = StandInWorld()
    with RecordingWriter(tmp_path / "out") as writer:
        for frame in carla_frames(carla, client_of(world), CONFIG, SIZE):
            assert world.settings.synchronous_mode
            writer.write(frame)
    read = open_sequence(tmp_path / "out")
    assert len(read) == 10  # 0 to 9 m, the end of the lane
    assert (np.diff(read.t_ns) == 100_000_000).all()
    for index, pose in enumerate(read.poses):
        assert pose is not None  # right is -x, the height is 1.6 m, y is mirrored
        np.testing.assert_allclose(pose.translation, [58.0, -float(index), 1.8], atol=1e-4)
        np.testing.assert_allclose(pose.rotation[:, 2], [0.0, -1.0, 0.0], atol=1e-5)
    last = read[9]
    assert last.rig is not None
    assert last.right is not None
    assert last.rig.baseline == pytest.approx(CONFIG.baseline)
    assert last.rig.left == carla_camera(CONFIG.fov, SIZE)
    assert last.image[3, 3].tolist()[1:] == [
        (100 + 20 + 9) % 256,
        0,
    ]  # RGB: this very step, of the left camera
    assert last.right[3, 3, 2] == 1
    assert world.weather == carla.WeatherParameters.HardRainNoon
    assert not world.settings.synchronous_mode
    assert [sensor.ended for sensor in world.sensors] == [["stop", "destroy"]] * 3
    assert [values["name"] for values in world.blueprints] == [
        "sensor.camera.rgb",
        "sensor.camera.rgb",
        "sensor.camera.depth",
    ]
    assert world.blueprints[0]["motion_blur_intensity"] == "0"
    assert "lens_k" not in world.blueprints[2]


def test_depth_is_in_metres():
    frame = next(carla_frames(carla, client_of(StandInWorld()), CONFIG, SIZE))
    assert frame.depth is not None
    assert math.isnan(frame.depth.depth[0, 0])
    red, green, blue = 58, (100 + 20) % 256, 2
    assert frame.depth.depth[3, 3] == pytest.approx(
        (red + 256 * green + 65536 * blue) / (2**24 - 1) * 1000.0, rel=1e-6
    )


def test_ended_early_the_server_is_left_as_it_was():
    world = StandInWorld()
    frames = carla_frames(carla, client_of(world), CONFIG, SIZE)
    next(frames)
    frames.close()  # pyright: ignore[reportAttributeAccessIssue]
    assert not world.settings.synchronous_mode
    assert all(sensor.ended for sensor in world.sensors)


@pytest.mark.parametrize(
    ("world", "said"),
    [
        (StandInWorld(num_silent=123), "no image of step 123 within 0.2 s"),
        (StandInWorld(late=1), "does another client run steps"),
    ],
)
def test_a_server_that_does_not_keep_step(
    world: StandInWorld, said: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("topoloc.apps.formats.carla._ANSWER_S", 0.2)
    with pytest.raises(RecordingError, match=said):
        list(carla_frames(carla, client_of(world), CONFIG, SIZE))
    assert not world.settings.synchronous_mode


def test_settings_that_make_no_sense():
    with pytest.raises(RecordingError, match="spawn point 7 of 1 in Town00"):
        list(carla_frames(carla, client_of(StandInWorld()), CarlaConfig(start=7), SIZE))
    with pytest.raises(ConfigError, match="must be above 0"):
        list(carla_frames(carla, client_of(StandInWorld()), CarlaConfig(spacing=0.0), SIZE))
    with pytest.raises(ConfigError, match="200 degrees"):
        carla_camera(200.0, SIZE)


def test_the_middle_of_the_picture_looks_straight_on():
    camera = carla_camera(90.0, (800, 600))
    np.testing.assert_allclose(camera.img_from_cam(np.array([[1.0, 0.0, 1.0]])), [[799.5, 299.5]])
    assert camera.fx == pytest.approx(400.0)


def test_no_server_is_one_line(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("topoloc.apps.formats.carla._CONNECT_S", 0.5)
    with pytest.raises(RecordingError, match=r"no CARLA server answers at 127\.0\.0\.1:9"):
        carla_client("127.0.0.1:9")
