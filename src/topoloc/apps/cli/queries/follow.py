"""topoloc follow MAP|ATLAS SOURCE"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import Annotated

import tyro

from topoloc import (
    AtlasConfig,
    Localization,
    LocalizerConfig,
    StereoSequence,
    Tracker,
    TrackerConfig,
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
    option,
    print_line,
)
from topoloc.apps.cli.queries.query_answers import QueryFrame, capture_frames, format_answer
from topoloc.apps.cli.settings_file import read_settings
from topoloc.apps.formats.live import LiveSource, is_live
from topoloc.apps.robots.ros_publisher import RosPublisher
from topoloc.plugin import as_monocular


@dataclass(frozen=True)
class Command:
    """Hold the arguments of `topoloc follow`."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP|ATLAS")]
    """A map file, or an atlas."""
    source: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SOURCE")]
    """A webcam's number or device, an address (rtsp://, http://), a video, or a recording."""
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
    ros: Annotated[int | None, option("DOMAIN")] = None
    """Also publish the poses in this ROS 2 domain: /topoloc/pose, and TF from map to
    topoloc_camera."""
    config: File = None
    """TOML file with all other settings, as printed by `topoloc config follow`."""

    def run(self) -> int:
        settings = read_settings(self.config)
        localizer = open_localizer(
            self.map, settings.of(LocalizerConfig), self.features, settings.of(AtlasConfig)
        )
        if self.ros is not None and len(localizer.tile_ids) > 1:
            raise UsageError("--ros publishes poses of one world, and tiles have their own")
        with ExitStack() as stack:
            tracker = stack.enter_context(closing(Tracker(localizer, settings.of(TrackerConfig))))
            stop = stack.enter_context(catch_stop_signals())
            of_size = None if self.camera is None else parse_camera(localizer, self.camera)
            robots = None if self.ros is None else RosPublisher(self.ros)
            if is_live(self.source):
                frames = capture_frames(stack.enter_context(LiveSource(self.source)), stop)
            else:
                recording = open_recording(self.source, self.format, None, self.topics)
                frames = _read_frames(as_monocular(recording))
            for frame in frames:
                if stop.is_set():
                    break
                answer = frame.localize(tracker.cameras, tracker, of_size)
                result = answer.result
                if robots is not None and isinstance(result, Localization):
                    robots.publish(frame.t_ns, result.world_from_cam, result.covariance)
                line = format_answer(answer) if self.plain else json.dumps(answer.to_json())
                print_line(line)
        return 0


def _read_frames(sequence: StereoSequence) -> Iterator[QueryFrame]:
    """Yield the images of a recording with its own times."""
    for index, (name, t_ns) in enumerate(zip(sequence.names, sequence.t_ns, strict=True)):
        yield QueryFrame(name, t_ns, lambda index=index: sequence[index])
