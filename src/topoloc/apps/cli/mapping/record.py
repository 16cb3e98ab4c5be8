"""topoloc record zed|carla|webcam OUT."""

from __future__ import annotations

import re
import threading
from collections.abc import Generator, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from topoloc import CalibrationError, ConfigError, MissingExtraError, StereoFrame, TopolocError
from topoloc.apps.cli.output import (
    File,
    UsageError,
    catch_stop_signals,
    check_outputs,
    option,
    progress_bar,
    write_json,
)
from topoloc.apps.core_names import parse_calibration
from topoloc.apps.formats.carla import CarlaConfig, carla_client, carla_frames
from topoloc.apps.formats.live import LiveSource
from topoloc.apps.formats.recording_writer import RecordingWriter
from topoloc.apps.formats.svo import sdk_frames
from topoloc.apps.formats.zed import side_by_side_frames

_ZED_SIZE = (2560, 720)


@dataclass(frozen=True)
class Command:
    """Arguments of `topoloc record`."""

    kind: Annotated[
        tyro.conf.Positional[Literal["zed", "carla", "webcam"]],
        tyro.conf.arg(metavar="zed|carla|webcam"),
    ]
    """Source: a connected ZED, the simulator CARLA, or any camera or stream that OpenCV opens."""
    out: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="OUT")]
    """Folder of the recording, new or empty."""
    source: Annotated[str | None, option("SOURCE", "0; for a ZED its SDK if installed")] = None
    """Device number or /dev/video0, rtsp:// or http:// URL, GStreamer pipeline, or a video file."""
    camera: Annotated[str | None, option("FILE|fx,fy,cx,cy")] = None
    """Calibration: SN*.conf of a ZED without its SDK; camera.json, OpenCV's or Kalibr's YAML, or
    four numbers of a webcam."""
    size: Annotated[str | None, option("WxH", "the device's; ZED 2560x720, CARLA 800x600")] = None
    """Requested image size; for a ZED that of both images side by side."""
    fps: Annotated[float | None, option("N", "all")] = None
    """Maximum number of frames a second."""
    frames: Annotated[int | None, option("N", "until Ctrl-C")] = None
    """Number of frames after which the recording ends."""
    jpeg: Annotated[int | None, option("1-100", "PNG")] = None
    """JPEG quality of the images."""
    carla: tyro.conf.OmitArgPrefixes[CarlaConfig] = field(default_factory=CarlaConfig)
    json: File = None
    """Write the printed facts as JSON to this file (- for standard output)."""

    def run(self) -> int:
        self._check_usage()
        check_outputs([self.json])
        with RecordingWriter(Path(self.out), self.jpeg) as writer, ExitStack() as stack:
            stop = stack.enter_context(catch_stop_signals())
            frames = stack.enter_context(closing(self._frames(stop, stack)))
            last = self._write(writer, frames, stop)
        if last is None:
            raise TopolocError(f"nothing recorded: {self.source or self.kind} gave no image")
        facts = {
            "out": self.out,
            "num_frames": writer.num_frames,
            "stereo": last.right is not None,
            "depth": last.depth is not None,
            "poses": last.world_from_cam is not None,
        }
        if self.json != "-":
            content = ", ".join(name for name in ("stereo", "depth", "poses") if facts[name])
            print(f"{self.out}: {writer.num_frames} frames{f' ({content})' if content else ''}")
        write_json(self.json, facts)
        return 0

    def _write(
        self, writer: RecordingWriter, frames: Iterator[StereoFrame], stop: threading.Event
    ) -> StereoFrame | None:
        """Write the frames, at most `fps` a second, and return the last one."""
        last, next_ns = None, None
        step_ns = 0 if self.fps is None else round(1e9 / self.fps)
        with progress_bar() as progress:
            try:
                for frame in frames:
                    if next_ns is None or frame.t_ns >= next_ns:
                        writer.write(frame)
                        last, next_ns = frame, frame.t_ns + step_ns
                        progress("frames", writer.num_frames, self.frames or writer.num_frames)
                    if stop.is_set() or writer.num_frames == self.frames:
                        break
            except TopolocError as error:
                if last is None:
                    raise
                raise TopolocError(
                    f"{error} ({self.out} has the {writer.num_frames} frames before)"
                ) from error
        return last

    def _frames(
        self, stop: threading.Event, stack: ExitStack
    ) -> Generator[StereoFrame, None, None]:
        """Open the source and yield its frames."""
        if self.kind == "carla":
            try:
                carla, client = carla_client(self.carla.server)
            except ConfigError as error:
                raise UsageError(str(error)) from None
            yield from carla_frames(carla, client, self.carla, self._size() or (800, 600))
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
                "--source and --camera are not for CARLA; use --server, --size and --fov"
            )
        if self.kind != "carla" and self.carla != CarlaConfig():
            raise UsageError(f"options of CARLA do not apply to {self.kind}")
        self._size()

    def _size(self) -> tuple[int, int] | None:
        if self.size is None:
            return None
        match = re.fullmatch(r"([0-9]{1,5})[xX]([0-9]{1,5})", self.size)
        width, height = (int(match[1]), int(match[2])) if match else (0, 0)
        if not (0 < width <= 16384 and 0 < height <= 16384):
            raise UsageError(f"--size {self.size[:40]} is no WIDTHxHEIGHT")
        return width, height


def _single_frames(source: LiveSource, calibration_option: str | None) -> Iterator[StereoFrame]:
    calibration = None if calibration_option is None else parse_calibration(calibration_option)
    camera = None
    for picture in source:
        height, width = picture.image.shape[:2]
        if calibration is not None and camera is None:
            camera = calibration(width, height).camera
        if camera is not None and (camera.width, camera.height) != (width, height):
            raise CalibrationError(
                f"the images are {width}x{height}, but the calibration is for"
                f" {camera.width}x{camera.height}"
            )
        yield StereoFrame(f"{picture.number:06d}", picture.t_ns, picture.image, camera)
