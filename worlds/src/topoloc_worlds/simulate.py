"""topoloc simulate WORLD OUT."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from topoloc.cli.output import UsageError, check_outputs, interruptible, progress_bar, write_json
from topoloc.errors import CalibrationError, TopolocError
from topoloc.geometry.camera import Camera
from topoloc.sequences.camera_json import read_camera_json
from topoloc_worlds.conditions import find_condition
from topoloc_worlds.demo_recordings import render_recordings
from topoloc_worlds.recorder import ZED, RecordConfig, Recorded, record
from topoloc_worlds.rendering.renderer import RenderConfig
from topoloc_worlds.routes import RouteConfig
from topoloc_worlds.worlds import World, find_world

_MOMENTS_OF_BLUR = 5


@dataclass(frozen=True)
class Command:
    """What `topoloc simulate` takes."""

    world: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="WORLD")]
    """lab, corridor, hospital or street; `demo` renders the recordings of `topoloc demo` into the folder OUT, and takes no setting."""
    out: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="OUT")]
    """The recording's folder, which is made. A recording that was interrupted goes on where it stopped."""
    condition: Annotated[str, tyro.conf.arg(metavar="NAME")] = "day"
    """day (or clear), evening, night, cloudy or rain."""
    seed: int = 0
    """Another seed is another place of the same kind."""
    take: int = 0
    """Another take of the same place: another walk along the line, other noise, other drops."""
    arrangement: int = 0
    """Another arrangement: chairs, boxes, cars are moved."""
    laps: float = 1.0
    """Times round; 0.25 is a quarter."""
    length: Annotated[float | None, tyro.conf.arg(metavar="METRES", help_behavior_hint="")] = None
    """Metres along the line, instead of --laps."""
    num_frames: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """Stop after N frames."""
    start: Annotated[float, tyro.conf.arg(metavar="METRES")] = 0.0
    """Where on the line the first frame is."""
    spacing: Annotated[float | None, tyro.conf.arg(metavar="METRES", help_behavior_hint="(default: the world's)")] = None
    """Metres between frames on the straight; in bends they come closer."""
    speed: Annotated[float | None, tyro.conf.arg(metavar="M/S", help_behavior_hint="(default: the world's)")] = None
    """With --spacing, this gives the times."""
    lateral: Annotated[float, tyro.conf.arg(metavar="METRES")] = 0.0
    """Metres to the left of the line, seen in the direction of travel; negative is to the right."""
    reverse: tyro.conf.FlagCreatePairsOff[bool] = False
    """The other way round."""
    look: Annotated[float, tyro.conf.arg(metavar="DEGREES")] = 0.0
    """The camera is turned so far to the left."""
    wobble: Annotated[float, tyro.conf.arg(metavar="SIZE")] = 1.0
    """The sway of who walks or drives: 1 is natural, 0 is on rails."""
    shake: Annotated[float, tyro.conf.arg(metavar="SIZE")] = 0.0
    """The tremble of a camera held in the hand: 1 is natural."""
    camera: Annotated[str | None, tyro.conf.arg(metavar="FILE|fx,fy,cx,cy", help_behavior_hint="(default: 380,380, in the middle)")] = None
    """A camera.json, or four numbers in pixels with --size."""
    size: Annotated[str, tyro.conf.arg(metavar="WxH")] = "640x400"
    """Size of the pictures. Without --camera the field of view stays 80 degrees across."""
    focal_scale: Annotated[float, tyro.conf.arg(metavar="FACTOR")] = 1.0
    """Lengthen the focal length: 1.5 is a longer lens, 0.8 a wider one."""
    baseline: Annotated[float | None, tyro.conf.arg(metavar="METRES", help_behavior_hint="(default: 0.12, street 0.54)")] = None
    """Metres between the left and the right camera."""
    mono: tyro.conf.FlagCreatePairsOff[bool] = False
    """A single camera: pictures in images/, and a camera.json."""
    depth: tyro.conf.FlagCreatePairsOff[bool] = False
    """Exact depth pictures, too; with --mono this makes an RGB-D recording."""
    grey: tyro.conf.FlagCreatePairsOff[bool] = False
    """Grey pictures."""
    jpeg: Annotated[int | None, tyro.conf.arg(metavar="QUALITY", help_behavior_hint="(default: PNG)")] = None
    """JPEG files of this quality, 1 to 100."""
    motion_blur: tyro.conf.FlagCreatePairsOff[bool] = False
    """Average several moments of the exposure. Five times as slow."""
    lens_drops: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Drops of rain on the lens."""
    draft: tyro.conf.FlagCreatePairsOff[bool] = False
    """About ten times as fast, with rougher light."""
    processes: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="(default: by the number of cores)")] = None
    """Processes that render; they have no influence on the pictures."""
    overwrite: tyro.conf.FlagCreatePairsOff[bool] = False
    """Remove the recording in OUT if its settings are others."""
    json: Annotated[str | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """Write what was recorded to this file (- for standard output)."""

    def run(self) -> int:
        return self._record_demo() if self.world == "demo" else self._record()

    def _record_demo(self) -> int:
        if self != Command(self.world, self.out):
            raise UsageError("`simulate demo` takes no setting")
        try:
            with interruptible(), progress_bar() as draw:
                render_recordings(Path(self.out), draw)
        except KeyboardInterrupt:
            raise TopolocError(f"interrupted; the same command goes on from what is in {self.out}") from None
        return 0

    def _record(self) -> int:
        world, condition, out = find_world(self.world), find_condition(self.condition), Path(self.out)
        config = self._config(world)
        check_outputs([self.json])
        began, done, total = time.monotonic(), 0, 0

        def count(stage: str, num_done: int, num: int) -> None:
            nonlocal done, total
            if stage == "frames":
                done, total = num_done, num
            draw(stage, num_done, num)

        try:
            with interruptible(), progress_bar() as draw:
                recorded = record(world, condition, out, config, count, self.processes, self.overwrite)
        except (KeyboardInterrupt, TopolocError) as stopped:
            if not total:
                raise
            what = "interrupted" if isinstance(stopped, KeyboardInterrupt) else str(stopped)
            raise TopolocError(f"{what} ({done} of {total} frames are in {out}; the same command goes on from there)") from stopped
        self._tell(out, recorded, time.monotonic() - began)
        return 0

    def _config(self, world: World) -> RecordConfig:
        if self.length is not None and self.laps != 1.0:
            raise UsageError("--laps and --length cannot both be given")
        if self.mono and self.baseline is not None:
            raise UsageError("--mono has no --baseline")
        return RecordConfig(
            seed=self.seed,
            arrangement=self.arrangement,
            route=self._route(world),
            camera=self._camera(),
            baseline=None if self.mono else world.baseline if self.baseline is None else self.baseline,
            render=RenderConfig.draft() if self.draft else RenderConfig(),
            num_renderings=_MOMENTS_OF_BLUR if self.motion_blur else 1,
            lens_drops=self.lens_drops,
            grey=self.grey,
            jpeg=self.jpeg,
            depth=self.depth,
        )

    def _route(self, world: World) -> RouteConfig:
        natural = world.route()
        return replace(
            natural,
            laps=self.laps,
            length=self.length,
            num_frames=self.num_frames,
            spacing=natural.spacing if self.spacing is None else self.spacing,
            speed=natural.speed if self.speed is None else self.speed,
            start=self.start,
            lateral=self.lateral,
            reverse=self.reverse,
            look=math.radians(self.look),
            wobble=self.wobble,
            shake=self.shake,
            seed=self.take,
        )

    def _camera(self) -> Camera:
        """What --camera, --size and --focal-scale say together. Raises UsageError, CalibrationError."""
        width, height = _size(self.size)
        if self.camera is None:
            focal = ZED.fx * width / ZED.width
            camera = Camera.pinhole(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
        elif "," in self.camera and not Path(self.camera).exists():
            try:
                fx, fy, cx, cy = map(float, self.camera.split(","))
            except ValueError:
                raise CalibrationError(f"--camera {self.camera}: neither a file nor four numbers fx,fy,cx,cy") from None
            camera = Camera.pinhole(width, height, fx, fy, cx, cy)
        else:
            camera = read_camera_json(Path(self.camera)).camera
            if camera.is_distorted:
                raise CalibrationError(f"{self.camera}: only undistorted cameras can be rendered, not {camera.model}")
        scale = self.focal_scale
        if not 0 < scale < math.inf:
            raise UsageError(f"--focal-scale {scale:g}: must be positive")
        return Camera.pinhole(camera.width, camera.height, camera.fx * scale, camera.fy * scale, camera.cx, camera.cy)

    def _tell(self, out: Path, recorded: Recorded, seconds: float) -> None:
        if self.json != "-":
            kept = recorded.num_frames - recorded.num_rendered
            before = f" ({kept} of them were there)" if kept else ""
            what = "single pictures" if self.mono else "stereo pairs"
            print(f"{out}: {recorded.num_frames} {what}{before}, {recorded.length:.1f} m, in {seconds:.0f} s")
        write_json(
            self.json,
            {
                "path": str(out),
                "world": self.world,
                "condition": find_condition(self.condition).name,
                "num_frames": recorded.num_frames,
                "num_rendered": recorded.num_rendered,
                "length_m": round(recorded.length, 3),
                "seconds": round(seconds, 3),
            },
        )


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit() and 16 <= int(width) <= 8192 and 16 <= int(height) <= 8192):
        raise UsageError(f"--size {text}: width and height in pixels are expected, 16 to 8192, as 640x400")
    return int(width), int(height)
