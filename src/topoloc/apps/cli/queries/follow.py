"""topoloc follow MAP|ATLAS SOURCE"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from itertools import chain, pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from topoloc import (
    AtlasConfig,
    Gyroscope,
    Localizer,
    LocalizerConfig,
    NotLocalized,
    StereoSequence,
    StreamedPose,
    Tracker,
    TrackerConfig,
)
from topoloc.apps.cli.features_option import QUERY_FEATURES, open_localizer, parse_camera
from topoloc.apps.cli.output import (
    File,
    Flag,
    Format,
    MaskOption,
    Topics,
    UsageError,
    catch_stop_signals,
    open_recording,
    option,
    print_line,
    print_warning,
)
from topoloc.apps.cli.queries.query_answers import QueryFrame, capture_frames, format_answer
from topoloc.apps.cli.settings_file import read_settings, with_option
from topoloc.apps.core_names import as_monocular
from topoloc.apps.formats.live import LiveSource, is_live
from topoloc.apps.robots.config import RobotConfig
from topoloc.apps.robots.imu import ImuFeed, make_gyroscope, take_from_file, take_from_topic
from topoloc.apps.robots.mavlink import DroneLocalizer, choose_origin
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
    mask: MaskOption = None
    format: Format = None
    topics: Topics = None
    """Topic of a bag: left=/cam0/image_raw."""
    features: QUERY_FEATURES = None
    """Feature types of the map to use, in order. The next one is used if the pose is unclear."""
    imu: Annotated[str | None, option("FILE|ros:TOPIC")] = None
    """Gyroscope that bridges blurred and dark images: a CSV file (time, then rad/s about x, y and
    z), or a topic of ROS 2. It has the clock of the images."""
    cam_from_imu: Annotated[str | None, option("W,X,Y,Z", "found from the images")] = None
    """Rotation from the IMU's axes to the camera's, a quaternion."""
    plain: Flag = False
    """Print readable lines instead of JSON."""
    realtime: Flag = False
    """Play a recording at its own pace, with this machine's times. Late images are left out."""
    simulated: Flag = False
    """The images are of a simulator without noise: equal ones show that the camera stands. With
    odometry this is found."""
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
    `udpin:HOST:PORT`, to whoever writes to this port. Give --realtime with a recording."""
    config: File = None
    """TOML file with all other settings, as printed by `topoloc config follow`."""

    def run(self) -> int:
        settings = read_settings(self.config)
        config = with_option(settings.get(LocalizerConfig), "mask", self.mask, "--mask")
        localizer = open_localizer(self.map, config, self.features, settings.get(AtlasConfig))
        if self.realtime and (is_topic(self.source) or is_live(self.source)):
            raise UsageError("--realtime plays a recording; leave it out for a live camera")
        if self.ros or self.mavlink is not None:
            self._check_world(localizer)
        tracking = settings.get(TrackerConfig)
        tracking = replace(tracking, simulated=self.simulated or tracking.simulated)
        with ExitStack() as stack:
            gyroscope = self._make_gyroscope()
            tracker = Tracker(localizer, tracking, gyroscope=gyroscope)
            stack.enter_context(closing(tracker))
            stop = stack.enter_context(catch_stop_signals())
            of_size = None if self.camera is None else parse_camera(localizer, self.camera)
            config, node, images = self._robot_config(settings.get(RobotConfig)), None, None
            if self.ros or is_topic(self.source) or is_topic(self.imu or ""):
                node = stack.enter_context(closing(RosNode(config)))
            if node is not None and is_topic(self.source):
                images = RosImages(node, self.source, of_size is not None, print_warning)
                frames = images.frames(stop)
            else:
                frames = self._open_frames(stack, stop)
            if gyroscope is not None:
                imu_node = node if is_topic(self.imu or "") else None
                frames = self._open_imu(gyroscope, imu_node).feed(frames)
            robot = None
            if node is not None and self.ros:
                robot = RobotLocalizer(node, config, images, print_warning)
                stack.enter_context(closing(robot))
            drone = None
            if self.mavlink is not None:
                origin = self._choose_origin(localizer)
                drone = DroneLocalizer(self.mavlink, print_warning, origin)
                stack.enter_context(closing(drone))
            last_ns, has_warned = 0, robot is not None  # the robot does so itself
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
                if not has_warned and (fault := _describe_hang(answer.streamed)):
                    has_warned = True
                    print_warning(f"{self.source}: {fault}")
                if drone is not None and answer.streamed is not None:
                    drone.take(answer.streamed)
                print_line(format_answer(answer) if self.plain else json.dumps(answer.to_json()))
        return 0

    def _open_frames(self, stack: ExitStack, stop: threading.Event) -> Iterator[QueryFrame]:
        """Return the images of a camera or a recording."""
        if is_live(self.source):
            return capture_frames(stack.enter_context(LiveSource(self.source)), stop)
        recording = open_recording(self.source, self.format, None, self.topics)
        frames = _read_frames(as_monocular(recording))
        return _play(frames, stop) if self.realtime else frames

    def _make_gyroscope(self) -> Gyroscope | None:
        """Return the gyroscope, None if there is no IMU. Raises UsageError: options that clash."""
        if self.imu is None:
            if self.cam_from_imu is not None:
                raise UsageError("--cam-from-imu needs --imu")
            return None
        is_recording = not (self.realtime or is_topic(self.source) or is_live(self.source))
        if is_topic(self.imu) == is_recording:
            kind = "FILE, and no --realtime" if is_recording else "ros:TOPIC"
            raise UsageError(f"--imu needs the clock of the images: give --imu {kind}")
        return make_gyroscope(self.cam_from_imu)

    def _open_imu(self, gyroscope: Gyroscope, node: RosNode | None) -> ImuFeed:
        name = self.imu or ""
        take = take_from_file(Path(name)) if node is None else take_from_topic(node, name)
        return ImuFeed(
            name, gyroscope, take, lambda text: print_line(text, sys.stderr), print_warning
        )

    def _check_world(self, localizer: Localizer) -> None:
        """Warn if z of the map does not point up. Raises UsageError: it has several worlds;
        MapError: it has no scale."""
        if len(localizer.tile_ids) > 1:
            raise UsageError("robots need poses of one world, and tiles have their own")
        localizer.topomap.require_scale("a robot")
        axes = [one.world_from_cam.rotation[2, 1] for one in localizer.topomap.summaries]
        max_tilt = 40.0  # degrees of the mean camera
        if axes and np.degrees(np.arccos(-np.mean(axes))) > max_tilt:
            print_warning(
                f"{self.map}: z does not point up in this map, as robots expect; `topoloc level"
                f" {self.map}` makes it so"
            )

    def _choose_origin(self, localizer: Localizer) -> np.ndarray | None:
        """Return the point that is sent as 0, and say so, if the map is far from its own."""
        places = [one.world_from_cam.translation for one in localizer.topomap.summaries]
        origin = choose_origin(np.reshape(places, (-1, 3)))
        if origin is not None:
            x, y, z = origin
            print_warning(
                f"{self.map}: positions are sent relative to {x:.0f},{y:.0f},{z:.0f} m of its"
                " world, because MAVLink's numbers of 32 bits cannot hold them; set the autopilot's"
                " origin there"
            )
        return origin

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


def _play(frames: Iterator[QueryFrame], stop: threading.Event) -> Iterator[QueryFrame]:
    """Yield images when they are due by this machine's clock, with its times, until `stop`. One
    whose next is due is left out."""
    offset_ns: int | None = None
    for frame, after in pairwise(chain(frames, [None])):
        if frame is None or stop.is_set():
            return
        now_ns = time.time_ns()
        offset_ns = now_ns - frame.t_ns if offset_ns is None else offset_ns
        if after is not None and after.t_ns + offset_ns <= now_ns:
            continue
        stop.wait(max(frame.t_ns + offset_ns - now_ns, 0) / 1e9)
        yield replace(frame, t_ns=frame.t_ns + offset_ns)


def _describe_hang(answer: StreamedPose | None) -> str | None:
    """Return why images that equal each other end a stream."""
    if answer is None or not answer.is_repeated or answer.state != "lost":
        return None
    return answer.result.detail if isinstance(answer.result, NotLocalized) else None
