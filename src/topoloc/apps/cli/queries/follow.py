"""topoloc follow MAP|ATLAS SOURCE"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import Annotated

import tyro

from topoloc import (
    AtlasConfig,
    CalibrationError,
    Localization,
    LocalizerConfig,
    NotLocalized,
    StereoFrame,
    StereoSequence,
    StreamedPose,
    Tracker,
    TrackerConfig,
    UncalibratedCamera,
    UnreadableImageError,
)
from topoloc.apps.cli.features_option import QUERY_FEATURES, open_localizer, parse_camera
from topoloc.apps.cli.output import (
    File,
    Flag,
    Format,
    Topics,
    UsageError,
    catch_stop_signals,
    open_recording,
)
from topoloc.apps.cli.queries.query_answers import QueryAnswer, format_answer
from topoloc.apps.cli.settings_file import read_settings
from topoloc.apps.formats.live import LiveSource, is_live
from topoloc.apps.query_camera import CameraOfSize, select_frame_camera
from topoloc.apps.robots.ros_publisher import RosPublisher
from topoloc.plugin import as_monocular

ReadFrame = Callable[[], StereoFrame]
"""A function that reads the next image. It raises UnreadableImageError."""


@dataclass(frozen=True)
class Command:
    """Hold the arguments of `topoloc follow`."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP|ATLAS")]
    """A map file, or an atlas."""
    source: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SOURCE")]
    """A webcam's number or device, an address (rtsp://, http://), a video, or a recording."""
    camera: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="FILE|fx,fy,cx,cy|map", help_behavior_hint="(default: that of the recording)"
        ),
    ] = None
    """Calibration of the images: a camera.json, YAML of OpenCV or Kalibr, `fx,fy,cx,cy` in
    pixels, or `map` for that of the map."""
    format: Format = None
    """Format of a recording: kitti, euroc, tum, seven_scenes, nerfstudio, record3d, colmap, rosbag,
    mcap, zed, video or folder."""
    topics: Topics = None
    """Topic of a bag: left=/cam0/image_raw."""
    features: QUERY_FEATURES = None
    """Feature types of the map to use, in order. The next one is used if the pose is unclear."""
    plain: Flag = False
    """Print readable lines instead of JSON."""
    ros: Annotated[int | None, tyro.conf.arg(metavar="DOMAIN", help_behavior_hint="")] = None
    """Also publish the poses in this ROS 2 domain: /topoloc/pose, and TF from map to
    topoloc_camera."""
    config: File = None
    """TOML file with all other settings, as printed by `topoloc config follow`."""

    def run(self) -> int:
        if self.camera == "unknown":
            raise UsageError("a stream needs a calibration: --camera FILE, fx,fy,cx,cy or map")
        settings = read_settings(self.config)
        localizer = open_localizer(
            self.map, settings.of(LocalizerConfig), self.features, settings.of(AtlasConfig)
        )
        if self.ros is not None and len(localizer.tile_ids) > 1:
            raise UsageError("--ros publishes poses of one world, and tiles have their own")
        tracker = Tracker(localizer, settings.of(TrackerConfig))
        with closing(tracker), catch_stop_signals() as is_ended:
            of_size = None if self.camera is None else parse_camera(tracker.localizer, self.camera)
            robots = None if self.ros is None else RosPublisher(self.ros)
            for name, t_ns, read in self._read_images(is_ended):
                if is_ended.is_set():
                    break
                streamed = _track_frame(tracker, t_ns, read, of_size)
                answer = QueryAnswer(name, t_ns, streamed.result, streamed)
                if robots is not None and isinstance(streamed.result, Localization):
                    robots.publish(t_ns, streamed.result.world_from_cam, streamed.result.covariance)
                print(
                    format_answer(answer) if self.plain else json.dumps(answer.to_json()),
                    flush=True,
                )
        return 0

    def _read_images(self, is_ended: threading.Event) -> Iterator[tuple[str, int, ReadFrame]]:
        if is_live(self.source):
            return _capture_frames(self.source, is_ended)
        return _read_recording(
            as_monocular(open_recording(self.source, self.format, None, self.topics))
        )


def _track_frame(
    tracker: Tracker, t_ns: int, read: ReadFrame, of_size: CameraOfSize | None
) -> StreamedPose:
    """Localize the next image. Raises CalibrationError: its camera is unknown."""
    try:
        frame = read()
    except UnreadableImageError as error:
        return tracker.process_missing(t_ns, NotLocalized("unreadable", detail=str(error)))
    camera = select_frame_camera(frame, of_size)
    if isinstance(camera, UncalibratedCamera):
        raise CalibrationError("a stream needs a calibration: --camera FILE, fx,fy,cx,cy or map")
    return tracker.process(frame.image, camera, t_ns)


def _read_recording(sequence: StereoSequence) -> Iterator[tuple[str, int, ReadFrame]]:
    """Yield the images of a recording with its own times."""
    for index, (name, t_ns) in enumerate(zip(sequence.names, sequence.t_ns, strict=True)):
        yield name, t_ns, lambda index=index: sequence[index]


def _capture_frames(source: str, is_ended: threading.Event) -> Iterator[tuple[str, int, ReadFrame]]:
    """Yield the newest image of a live source each time, with this machine's time."""
    with LiveSource(source) as live:
        live.stop = is_ended
        for picture in live:
            frame = StereoFrame(f"{picture.number:06d}", picture.t_ns, picture.image, None)
            yield frame.name, frame.t_ns, lambda frame=frame: frame
