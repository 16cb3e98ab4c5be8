"""topoloc follow MAP|ATLAS SOURCE"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import tyro

from topoloc import AtlasConfig, Localizer, LocalizerConfig, StereoSequence, Tracker, TrackerConfig
from topoloc.apps.cli.features_option import QUERY_FEATURES, open_localizer, parse_camera
from topoloc.apps.cli.output import (
    File,
    Flag,
    Format,
    Topics,
    UsageError,
    catch_stop_signals,
    open_recording,
    option,
    print_line,
    print_warning,
)
from topoloc.apps.cli.queries.query_answers import QueryFrame, capture_frames, format_answer
from topoloc.apps.cli.settings_file import read_settings
from topoloc.apps.core_names import as_monocular
from topoloc.apps.formats.live import LiveSource, is_live
from topoloc.apps.robots.config import RobotConfig
from topoloc.apps.robots.mavlink import DroneLocalizer
from topoloc.apps.robots.robot_localizer import RobotLocalizer
from topoloc.apps.robots.ros_images import RosImages, is_topic
from topoloc.apps.robots.ros_node import RosNode


@dataclass(frozen=True)
class Command:
    """Hold the arguments of `topoloc follow`."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP|ATLAS")]
    """A map file, or an atlas."""
    source: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SOURCE")]
    """A webcam's number or device, an address (rtsp://, http://), a topic of ROS 2
    (ros:/camera/image_raw), a video, or a recording."""
    camera: Annotated[
        str | None, option("FILE|fx,fy,cx,cy|map|unknown", "that of the recording")
    ] = None
    """Calibration of the images: a camera.json, YAML of OpenCV or Kalibr, `fx,fy,cx,cy` in
    pixels, `map` for that of the map, or `unknown` to estimate it from the first images."""
    format: Format = None
    topics: Topics = None
    """Topic of a bag: left=/cam0/image_raw."""
    features: QUERY_FEATURES = None
    """Feature types of the map to use, in order. The next one is used if the pose is unclear."""
    plain: Flag = False
    """Print readable lines instead of JSON."""
    ros: Flag = False
    """Localize a robot of ROS 2: publish TF from map to odom, /topoloc/pose and /diagnostics in the
    domain ROS_DOMAIN_ID."""
    odom: Annotated[str | None, option("FRAME|none", "odom")] = None
    """With --ros: the frame of the odometry in TF. `none`: there is no odometry, and TF is from map
    to topoloc_camera."""
    map_frame: Annotated[str | None, option("FRAME", "map")] = None
    """With --ros: the frame of the map in TF."""
    base_frame: Annotated[str | None, option("FRAME", "base_link")] = None
    """With --ros: the frame of the robot in TF."""
    camera_frame: Annotated[str | None, option("FRAME", "topoloc_camera")] = None
    """With --ros: the optical frame of the camera in TF, if the images are of no topic."""
    namespace: Annotated[str | None, option("NAME")] = None
    """With --ros: the namespace of /topoloc/pose and /initialpose."""
    planar: Flag = False
    """With --ros: publish x, y and yaw only."""
    use_sim_time: Flag = False
    """With --ros: take the time from /clock."""
    publish_initial_pose: Flag = False
    """With --ros: publish the first confirmed pose on /initialpose, instead of reading it."""
    mavlink: Annotated[str | None, option("udpout:HOST:PORT")] = None
    """Send the poses to an autopilot, as ODOMETRY of a drone whose camera looks ahead. Or
    `udpin:HOST:PORT`, to whoever writes to this port."""
    config: File = None
    """TOML file with all other settings, as printed by `topoloc config follow`."""

    def run(self) -> int:
        settings = read_settings(self.config)
        localizer = open_localizer(
            self.map, settings.get(LocalizerConfig), self.features, settings.get(AtlasConfig)
        )
        if self.ros or self.mavlink is not None:
            self._check_world(localizer)
        with ExitStack() as stack:
            tracker = stack.enter_context(closing(Tracker(localizer, settings.get(TrackerConfig))))
            stop = stack.enter_context(catch_stop_signals())
            of_size = None if self.camera is None else parse_camera(localizer, self.camera)
            config, node, images = self._robot_config(settings.get(RobotConfig)), None, None
            if self.ros or is_topic(self.source):
                node = stack.enter_context(closing(RosNode(config)))
            if node is not None and is_topic(self.source):
                images = RosImages(node, self.source, of_size is not None, print_warning)
                frames = images.frames(stop)
            elif is_live(self.source):
                frames = capture_frames(stack.enter_context(LiveSource(self.source)), stop)
            else:
                recording = open_recording(self.source, self.format, None, self.topics)
                frames = _read_frames(as_monocular(recording))
            robot = None
            if node is not None and self.ros:
                robot = RobotLocalizer(node, config, images, print_warning)
                stack.enter_context(closing(robot))
            drone = None
            if self.mavlink is not None:
                drone = stack.enter_context(closing(DroneLocalizer(self.mavlink, print_warning)))
            last_ns = 0
            for frame in frames:
                if stop.is_set():
                    break
                if images is not None and frame.t_ns < last_ns:  # a bag that is played again
                    tracker.reset()
                last_ns = frame.t_ns
                if robot is None:
                    answer = frame.localize(tracker.cameras, tracker, of_size)
                else:
                    answer = robot.localize(frame, tracker, of_size)
                if drone is not None and answer.streamed is not None:
                    drone.take(answer.streamed)
                print_line(format_answer(answer) if self.plain else json.dumps(answer.to_json()))
        return 0

    def _check_world(self, localizer: Localizer) -> None:
        """Warn if z of the map does not point up. Raises UsageError: it has several worlds."""
        if len(localizer.tile_ids) > 1:
            raise UsageError("robots need poses of one world, and tiles have their own")
        axes = [one.world_from_cam.rotation[2, 1] for one in localizer.topomap.summaries]
        max_tilt = 40.0  # degrees of the mean camera
        if axes and np.degrees(np.arccos(-np.mean(axes))) > max_tilt:
            print_warning(
                f"{self.map}: z does not point up in this map, as robots expect; `topoloc level"
                f" {self.map}` makes it so"
            )

    def _robot_config(self, config: RobotConfig) -> RobotConfig:
        if not self.ros:
            self._refuse_options_of_ros()
        config = replace(
            config,
            odom_frame=self.odom or config.odom_frame,
            map_frame=self.map_frame or config.map_frame,
            base_frame=self.base_frame or config.base_frame,
            camera_frame=self.camera_frame or config.camera_frame,
            namespace=self.namespace or config.namespace,
            planar=self.planar or config.planar,
            use_sim_time=self.use_sim_time or config.use_sim_time,
            publish_initial_pose=self.publish_initial_pose or config.publish_initial_pose,
        )
        if config.planar and not config.has_odometry:
            raise UsageError("--planar is of a robot with odometry; leave out --odom none")
        return config

    def _refuse_options_of_ros(self) -> None:
        names = (
            "odom map_frame base_frame camera_frame namespace planar use_sim_time"
            " publish_initial_pose"
        )
        for name in names.split():
            if getattr(self, name):
                raise UsageError(f"--{name.replace('_', '-')} needs --ros")


def _read_frames(sequence: StereoSequence) -> Iterator[QueryFrame]:
    """Yield the images of a recording with its own times."""
    for index, (name, t_ns) in enumerate(zip(sequence.names, sequence.t_ns, strict=True)):
        yield QueryFrame(name, t_ns, lambda index=index: sequence[index])
