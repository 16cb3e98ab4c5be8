"""topoloc record zed|carla|webcam OUT."""

from __future__ import annotations

import threading
from collections.abc import Generator, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from topoloc import CalibrationError, MissingExtraError, StereoFrame, TopolocError
from topoloc.apps.cli.output import (
    File,
    UsageError,
    catch_stop_signals,
    check_outputs,
    progress_bar,
    write_json,
)
from topoloc.apps.formats.capture.carla_capture import (
    CarlaConfig,
    Weather,
    carla_client,
    carla_frames,
)
from topoloc.apps.formats.capture.recording_writer import RecordingWriter
from topoloc.apps.formats.capture.zed_capture import sdk_frames, side_by_side_frames
from topoloc.apps.formats.live import LiveSource
from topoloc.plugin import parse_calibration

_ZED_SIZE = (2560, 720)


@dataclass(frozen=True)
class CarlaOptions:
    """Where CARLA is recorded, and how (metres, degrees)."""

    server: Annotated[str, tyro.conf.arg(metavar="HOST:PORT")] = "localhost:2000"
    """The running server."""
    town: Annotated[
        str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="(default: as it is)")
    ] = None
    """The town that is loaded, such as Town10HD."""
    weather: Weather = "clear"
    """The paper's: clear noon, cloudy noon, hard rain at noon."""
    start: int = 0
    """The spawn point at which the way begins; it follows the lane, and at junctions goes straight
    on."""
    length: float = 300.0
    """Length of the way."""
    spacing: float = 0.5
    """From frame to frame."""
    lane_offset: float = 0.0
    """To the right of the lane's middle; negative to the left."""
    height: float = 1.6
    """Of the cameras above the lane."""
    baseline: float = 0.5
    """From the left to the right camera."""
    fov: float = 90.0
    """Horizontal field of view."""


@dataclass(frozen=True)
class Command:
    """What `topoloc record` takes."""

    kind: Annotated[
        tyro.conf.Positional[Literal["zed", "carla", "webcam"]],
        tyro.conf.arg(metavar="zed|carla|webcam"),
    ]
    """What is recorded: a ZED that is plugged in, the simulator CARLA, or any camera or stream that
    OpenCV opens."""
    out: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="OUT")]
    """The recording's folder: a new one, or an empty one."""
    source: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="SOURCE",
            help_behavior_hint="(default: 0; of a ZED its SDK where that is installed)",
        ),
    ] = None
    """Device number or /dev/video0, rtsp:// or http:// URL, GStreamer pipeline, or a video file."""
    camera: Annotated[
        str | None, tyro.conf.arg(metavar="FILE|fx,fy,cx,cy", help_behavior_hint="")
    ] = None
    """Calibration: of a ZED without its SDK the SN*.conf; of a webcam a camera.json, OpenCV's or
    Kalibr's YAML, or four numbers."""
    size: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="WxH", help_behavior_hint="(default: the device's; ZED 2560x720, CARLA 800x600)"
        ),
    ] = None
    """Pixels that the device is asked for; of a ZED of both pictures side by side."""
    fps: Annotated[
        float | None, tyro.conf.arg(metavar="N", help_behavior_hint="(default: all)")
    ] = None
    """Frames a second at most."""
    frames: Annotated[
        int | None, tyro.conf.arg(metavar="N", help_behavior_hint="(default: until Ctrl-C)")
    ] = None
    """Ends after so many frames."""
    jpeg: Annotated[
        int | None, tyro.conf.arg(metavar="1-100", help_behavior_hint="(default: PNG)")
    ] = None
    """Store pictures as JPEG of this quality."""
    carla: tyro.conf.OmitArgPrefixes[CarlaOptions] = field(default_factory=CarlaOptions)
    json: File = None
    """Write what is printed as JSON to this file (- for standard output)."""

    def run(self) -> int:
        self._check_usage()
        check_outputs([self.json])
        with RecordingWriter(Path(self.out), self.jpeg) as writer, ExitStack() as stack:
            stop = stack.enter_context(catch_stop_signals())
            frames = stack.enter_context(closing(self._frames(stop, stack)))
            last = self._write(writer, frames, stop)
        if last is None:
            raise TopolocError(f"nothing recorded: {self.source or self.kind} gave no picture")
        facts = {
            "out": self.out,
            "num_frames": writer.num_frames,
            "stereo": last.right is not None,
            "depth": last.depth is not None,
            "poses": last.world_from_cam is not None,
        }
        if self.json != "-":
            what = ", ".join(name for name in ("stereo", "depth", "poses") if facts[name])
            print(f"{self.out}: {writer.num_frames} frames{f' ({what})' if what else ''}")
        write_json(self.json, facts)
        return 0

    def _write(
        self, writer: RecordingWriter, frames: Iterator[StereoFrame], stop: threading.Event
    ) -> StereoFrame | None:
        """Writes all frames that come, no more of them than are wanted a second; gives the last."""
        last, next_ns = None, None
        with progress_bar() as progress:
            try:
                for frame in frames:
                    if next_ns is None or frame.t_ns >= next_ns:
                        writer.write(frame)
                        last, next_ns = (
                            frame,
                            frame.t_ns + (0 if self.fps is None else round(1e9 / self.fps)),
                        )
                        progress("frames", writer.num_frames, self.frames or writer.num_frames)
                    if stop.is_set() or writer.num_frames == self.frames:
                        break
            except TopolocError as error:
                if last is None:
                    raise
                raise TopolocError(
                    f"{error} ({writer.num_frames} frames before are in {self.out})"
                ) from error
        return last

    def _frames(
        self, stop: threading.Event, stack: ExitStack
    ) -> Generator[StereoFrame, None, None]:
        """Raises what opening the camera, or connecting to the server, does."""
        if self.kind == "carla":
            config = self._carla_config()
            yield from carla_frames(*carla_client(config), config)
        elif self.kind == "zed" and self.source is None and self.camera is None:
            try:
                yield from sdk_frames(stop)
            except MissingExtraError as error:
                raise MissingExtraError(
                    f"{error}; without it --camera SN12345.conf records it as a USB camera"
                ) from None
        else:
            size = self._size() or (_ZED_SIZE if self.kind == "zed" else None)
            source = stack.enter_context(LiveSource(self.source or "0", keep_all=True, size=size))
            source.stop = stop
            if self.kind == "zed":
                if self.camera is None:
                    raise CalibrationError(
                        "a ZED without Stereolabs' SDK needs its calibration: --camera SN12345.conf"
                    )
                yield from side_by_side_frames(source, Path(self.camera))
            else:
                yield from _single_frames(source, self.camera)

    def _check_usage(self) -> None:
        if self.fps is not None and not self.fps > 0.0:
            raise UsageError("--fps must be above 0")
        if self.frames is not None and self.frames < 1:
            raise UsageError("--frames must be at least 1")
        if self.jpeg is not None and not 1 <= self.jpeg <= 100:
            raise UsageError("--jpeg is a quality from 1 to 100")
        if self.kind == "carla" and (self.source is not None or self.camera is not None):
            raise UsageError(
                "--source and --camera are not for CARLA, whose cameras are made: --server, --size"
                " and --fov say which"
            )
        if self.kind != "carla" and self.carla != CarlaOptions():
            raise UsageError(f"options of CARLA's are not for a {self.kind}")
        self._size()

    def _size(self) -> tuple[int, int] | None:
        if self.size is None:
            return None
        width, _, height = self.size.lower().partition("x")
        if not (
            width.isdigit()
            and height.isdigit()
            and 0 < int(width[:6]) <= 16384
            and 0 < int(height[:6]) <= 16384
        ):
            raise UsageError(f"--size {self.size[:40]} is no WIDTHxHEIGHT")
        return int(width), int(height)

    def _carla_config(self) -> CarlaConfig:
        its = self.carla
        host, _, port = its.server.rpartition(":")
        if not host or not port.isdigit() or not 0 < int(port[:6]) < 65536:
            raise UsageError(f"--server {its.server[:80]} is no HOST:PORT")
        width, height = self._size() or (CarlaConfig.width, CarlaConfig.height)
        return CarlaConfig(
            host=host,
            port=int(port),
            town=its.town,
            weather=its.weather,
            start=its.start,
            length_m=its.length,
            spacing_m=its.spacing,
            lane_offset_m=its.lane_offset,
            height_m=its.height,
            baseline_m=its.baseline,
            width=width,
            height=height,
            fov_deg=its.fov,
        )


def _single_frames(source: LiveSource, calibration_option: str | None) -> Iterator[StereoFrame]:
    calibration = None if calibration_option is None else parse_calibration(calibration_option)
    camera = None
    for picture in source:
        height, width = picture.image.shape[:2]
        if calibration is not None and camera is None:
            camera = calibration(width, height).camera
        if camera is not None and (camera.width, camera.height) != (width, height):
            raise CalibrationError(
                f"the pictures are {width}x{height}, their calibration is of"
                f" {camera.width}x{camera.height}"
            )
        yield StereoFrame(f"{picture.number:06d}", picture.t_ns, picture.image, camera)
