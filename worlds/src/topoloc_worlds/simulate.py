"""topoloc simulate WORLD OUT."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from topoloc.apps.cli.output import (
    File,
    Flag,
    UsageError,
    check_outputs,
    interruptible,
    progress_bar,
    write_json,
)
from topoloc.errors import CalibrationError, TopolocError
from topoloc.geometry.camera import Camera
from topoloc.recordings.camera_files import read_camera_json
from topoloc.recordings.trajectory import Trajectory
from topoloc.rigs.rig import Rig
from topoloc_worlds.conditions import find_condition
from topoloc_worlds.demo_recordings import render_recordings
from topoloc_worlds.recorder import ZED, RecordConfig, Recorded, record
from topoloc_worlds.rendering.renderer import RenderConfig
from topoloc_worlds.routes import RouteConfig, frame_poses, plan_route
from topoloc_worlds.worlds import World, find_world

_MOMENTS_OF_BLUR = 5
Sway = Literal["none", "natural", "hand"]
# Sizes of the sway of who walks or drives, and of the tremble of a hand.
_WOBBLE_AND_SHAKE: dict[Sway, tuple[float, float]] = {
    "none": (0.0, 0.0),
    "natural": (1.0, 0.0),
    "hand": (1.0, 1.0),
}


@dataclass(frozen=True)
class RouteOptions:
    """Set the camera's path along the world's closed line."""

    laps: Annotated[float, tyro.conf.arg(metavar="N")] = 1.0
    """Rounds of the line; 0.25 is a quarter."""
    num_frames: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """Stop after N frames."""
    start: Annotated[float, tyro.conf.arg(metavar="METRES")] = 0.0
    """Metres along the line to the first frame."""
    spacing: Annotated[
        float | None, tyro.conf.arg(metavar="METRES", help_behavior_hint="(default: the world's)")
    ] = None
    """Metres between frames on the straight; in bends they come closer."""
    lateral: Annotated[float, tyro.conf.arg(metavar="METRES")] = 0.0
    """Metres to the left of the line, seen in the direction of travel; negative is to the right."""
    reverse: Flag = False
    """Go round in the opposite direction."""
    look: Annotated[float, tyro.conf.arg(metavar="DEGREES")] = 0.0
    """Angle of the camera to the left of the direction of travel."""
    sway: Sway = "natural"
    """Sway of a walker or a car; `none` is on rails, `hand` adds a tremble."""


@dataclass(frozen=True)
class PictureOptions:
    """Set the camera and the format of the images."""

    camera: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="FILE|fx,fy,cx,cy", help_behavior_hint="(default: 380,380, in the middle)"
        ),
    ] = None
    """A camera.json, four numbers in pixels with --size, or a rig.json: a recording for each of its
    cameras."""
    size: Annotated[str, tyro.conf.arg(metavar="WxH")] = "640x400"
    """Size of the pictures. Without --camera the field of view stays 80 degrees across."""
    baseline: Annotated[
        float | None,
        tyro.conf.arg(metavar="METRES", help_behavior_hint="(default: 0.12, street 0.54)"),
    ] = None
    """Metres between the left and the right camera."""
    mono: Flag = False
    """A single camera: pictures in images/, and a camera.json."""
    depth: Flag = False
    """Exact depth pictures, too; with --mono this makes an RGB-D recording."""
    grey: Flag = False
    """Grey pictures."""
    jpeg: Annotated[
        int | None, tyro.conf.arg(metavar="QUALITY", help_behavior_hint="(default: PNG)")
    ] = None
    """JPEG files of this quality, 1 to 100."""
    motion_blur: Flag = False
    """Average several moments of the exposure. Five times as slow."""
    draft: Flag = False
    """About ten times as fast, with rougher light."""

    @property
    def rig(self) -> Path | None:
        """Return the file of --camera if it is that of a rig."""
        path = Path(self.camera or "")
        return path if path.name == "rig.json" else None


@dataclass(frozen=True)
class Command:
    """Define the arguments of `topoloc simulate`."""

    world: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="WORLD")]
    """lab, corridor, hospital or street; `demo` renders the recordings of `topoloc demo` into the
    folder OUT, and takes no setting."""
    out: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="OUT")]
    """The recording's folder, which is made. An interrupted recording is resumed."""
    condition: Annotated[str, tyro.conf.arg(metavar="NAME")] = "day"
    """day (or clear), evening, night, cloudy or rain."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Another seed is another place of the same kind."""
    take: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Another take of the same place: another walk along the line, other noise, other drops."""
    arrangement: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Another arrangement: chairs, boxes, cars are moved."""
    route: tyro.conf.OmitArgPrefixes[RouteOptions] = field(default_factory=RouteOptions)
    picture: tyro.conf.OmitArgPrefixes[PictureOptions] = field(default_factory=PictureOptions)
    processes: Annotated[
        int | None,
        tyro.conf.arg(metavar="N", help_behavior_hint="(default: by the number of cores)"),
    ] = None
    """Processes that render; they have no influence on the pictures."""
    overwrite: Flag = False
    """Remove the recording in OUT if its settings differ."""
    json: File = None
    """Write facts of the recording to this file (- for standard output)."""

    def run(self) -> int:
        return self._record_demo() if self.world == "demo" else self._record()

    def _record_demo(self) -> int:
        if self != Command(self.world, self.out):
            raise UsageError("`simulate demo` takes no setting")
        try:
            with interruptible(), progress_bar() as draw:
                render_recordings(Path(self.out), draw)
        except KeyboardInterrupt:
            raise TopolocError(
                f"interrupted; the same command goes on from what is in {self.out}"
            ) from None
        return 0

    def _record(self) -> int:
        world, out = find_world(self.world), Path(self.out)
        config = self._config(world)
        check_outputs([self.json])
        if (rig_file := self.picture.rig) is None:
            self._record_one(world, out, config)
            return 0
        rig = Rig.read(rig_file)
        for name, mounted in rig.cameras.items():
            mounting = tuple(map(tuple, mounted.rig_from_cam.tolist()))
            route = replace(config.route, mounting=mounting)
            camera = config.camera if mounted.camera is None else mounted.camera
            self._record_one(world, out / name, replace(config, route=route, camera=camera))
        write_json(str(out / "rig.json"), rig.to_json())
        route = plan_route(world.loop, world.camera_height, config.route)
        Trajectory(frame_poses(route), route.t_ns).write_tum(out / "truth.tum")
        return 0

    def _record_one(self, world: World, out: Path, config: RecordConfig) -> None:
        condition = find_condition(self.condition)
        began, done, total = time.monotonic(), 0, 0

        def count(stage: str, num_done: int, num: int) -> None:
            nonlocal done, total
            if stage == "frames":
                done, total = num_done, num
            draw(stage, num_done, num)

        try:
            with interruptible(), progress_bar() as draw:
                recorded = record(
                    world, condition, out, config, count, self.processes, self.overwrite
                )
        except (KeyboardInterrupt, TopolocError) as stopped:
            if not total:
                raise
            what = "interrupted" if isinstance(stopped, KeyboardInterrupt) else str(stopped)
            raise TopolocError(
                f"{what} ({done} of {total} frames are in {out}; the same command goes on from"
                " there)"
            ) from stopped
        self._tell(out, recorded, time.monotonic() - began)

    def _config(self, world: World) -> RecordConfig:
        pictures = self.picture
        is_mono = pictures.mono or pictures.rig is not None
        if is_mono and pictures.baseline is not None:
            raise UsageError("--mono and rigs have no --baseline")
        return RecordConfig(
            seed=self.seed,
            arrangement=self.arrangement,
            route=self._route(world),
            camera=_camera(pictures),
            baseline=(
                None
                if is_mono
                else world.baseline
                if pictures.baseline is None
                else pictures.baseline
            ),
            render=RenderConfig.draft() if pictures.draft else RenderConfig(),
            num_renderings=_MOMENTS_OF_BLUR if pictures.motion_blur else 1,
            grey=pictures.grey,
            jpeg=pictures.jpeg,
            depth=pictures.depth,
        )

    def _route(self, world: World) -> RouteConfig:
        natural, route = world.route(), self.route
        wobble, shake = _WOBBLE_AND_SHAKE[route.sway]
        return replace(
            natural,
            laps=route.laps,
            num_frames=route.num_frames,
            spacing=natural.spacing if route.spacing is None else route.spacing,
            start=route.start,
            lateral=route.lateral,
            reverse=route.reverse,
            look=math.radians(route.look),
            wobble=wobble,
            shake=shake,
            seed=self.take,
        )

    def _tell(self, out: Path, recorded: Recorded, seconds: float) -> None:
        if self.json != "-":
            kept = recorded.num_frames - recorded.num_rendered
            before = f" ({kept} of them were there)" if kept else ""
            is_mono = self.picture.mono or self.picture.rig is not None
            what = "single pictures" if is_mono else "stereo pairs"
            print(
                f"{out}: {recorded.num_frames} {what}{before}, {recorded.length:.1f} m, in"
                f" {seconds:.0f} s"
            )
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


def _camera(pictures: PictureOptions) -> Camera:
    """Return the camera of --camera and --size.

    Raises:
        UsageError, CalibrationError: the options are invalid.
    """
    width, height = _size(pictures.size)
    if pictures.camera is None or pictures.rig is not None:
        focal = ZED.fx * width / ZED.width
        return Camera.pinhole(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    if "," in pictures.camera and not Path(pictures.camera).exists():
        try:
            fx, fy, cx, cy = map(float, pictures.camera.split(","))
        except ValueError:
            raise CalibrationError(
                f"--camera {pictures.camera}: neither a file nor four numbers fx,fy,cx,cy"
            ) from None
        return Camera.pinhole(width, height, fx, fy, cx, cy)
    camera = read_camera_json(Path(pictures.camera)).camera
    if camera.is_distorted:
        raise CalibrationError(
            f"{pictures.camera}: only undistorted cameras can be rendered, not {camera.model}"
        )
    return Camera.pinhole(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not (
        width.isdigit()
        and height.isdigit()
        and 16 <= int(width) <= 8192
        and 16 <= int(height) <= 8192
    ):
        raise UsageError(
            f"--size {text}: width and height in pixels are expected, 16 to 8192, as 640x400"
        )
    return int(width), int(height)
