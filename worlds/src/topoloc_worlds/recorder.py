"""Walk a world with a camera and write the recording: resumable, in several processes, the same
bytes however it came about."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path

from topoloc.errors import CalibrationError, TopolocError
from topoloc.geometry.camera import Camera
from topoloc.recordings.trajectory import Trajectory
from topoloc_worlds.conditions import Condition
from topoloc_worlds.layout import Layout, missing_frames, prepare, write_shot
from topoloc_worlds.rendering.renderer import RenderConfig, Renderer
from topoloc_worlds.rendering.variant import LLVM, use_best_variant
from topoloc_worlds.routes import Route, RouteConfig, frame_poses, plan_route
from topoloc_worlds.sensor import SensorConfig
from topoloc_worlds.shots import Shooting, shoot
from topoloc_worlds.worlds import World

Progress = Callable[[str, int, int], None]

ZED = Camera.pinhole(640, 400, 380.0, 380.0, 319.5, 199.5)
"""Size and field of view (80 degrees) of a ZED camera's pictures as they are used for
localization."""

_FEW_FRAMES = 20


@dataclass(frozen=True)
class RecordConfig:
    """Define the settings of a recording. The recording depends on this, the world and the
    condition alone.

    Attributes:
        seed: the place of the world's kind.
        arrangement: the places of movable objects.
        route: the camera's path. `route.seed` also determines the noise and the drops.
        baseline: metres between the left and right camera; None for a single camera.
        num_renderings: renderings over the time of an exposure; 1 has no motion blur.
        lens_drops: drops on each lens.
        grey: store grey images.
        jpeg: quality of JPEG files; None for PNG.
        depth: store the left camera's depth, too.
    """

    seed: int = 0
    arrangement: int = 0
    route: RouteConfig = field(default_factory=RouteConfig)
    camera: Camera = ZED
    baseline: float | None = 0.12
    render: RenderConfig = field(default_factory=RenderConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    num_renderings: int = 1
    lens_drops: int = 0
    grey: bool = False
    jpeg: int | None = None
    depth: bool = False

    def __post_init__(self) -> None:
        if self.camera.is_distorted:
            raise CalibrationError(
                f"only undistorted cameras can be rendered, not {self.camera.model}"
                f" {self.camera.params}"
            )
        if self.baseline is not None and not 1e-3 <= self.baseline <= 10.0:
            raise CalibrationError(
                f"stereo rig: a baseline of {self.baseline:g} m cannot be rendered"
            )
        if self.jpeg is not None and not 1 <= self.jpeg <= 100:
            raise TopolocError(f"the quality of JPEG is 1 to 100, not {self.jpeg}")
        if self.num_renderings < 1 or self.lens_drops < 0:
            raise TopolocError("renderings a picture are 1 or more, and drops 0 or more")


@dataclass(frozen=True)
class Recorded:
    """Hold facts of the folder: its frames, the number that this run rendered, and metres
    travelled."""

    num_frames: int
    num_rendered: int
    length: float


def record(
    world: World,
    condition: Condition,
    out: Path,
    config: RecordConfig,
    progress: Progress = lambda stage, done, total: None,
    processes: int | None = None,
    overwrite: bool = False,
) -> Recorded:
    """Render a recording into the folder `out`. An interrupted recording is resumed.

    Frames are written one by one, each file atomically, so an interruption loses only the frames in
    progress.

    Args:
        progress: called with ("light", done, total) while the light of the world is traced, if
            needed, then with ("frames", done, total), also after a failure.
        processes: number of rendering processes; None chooses. It has no influence on the images.
        overwrite: remove an existing recording with other settings.

    Raises:
        MissingExtraError: Mitsuba is not installed.
        TopolocError: the route is impossible, or `out` cannot be written or holds something else.
    """
    variant = use_best_variant()
    route = plan_route(world.loop, world.camera_height, config.route)
    layout = _layout(world, out, config)
    prepare(
        layout,
        _settings(world, condition, config, variant, route),
        Trajectory(frame_poses(route), route.t_ns),
        overwrite,
    )
    missing = missing_frames(layout, route.num_frames)
    done = route.num_frames - len(missing)
    progress("frames", done, route.num_frames)
    job = _Job(world, condition, config, layout, variant)
    num = min(len(missing), processes or _num_processes(len(missing)))
    in_turn = (
        _render_here(job, missing, progress)
        if num <= 1
        else _render_in_processes(job, missing, num, progress)
    )
    try:
        with closing(in_turn):
            for _ in in_turn:
                done += 1
                progress("frames", done, route.num_frames)
    except BaseException:  # processes have finished their frames meanwhile
        progress(
            "frames",
            route.num_frames - len(missing_frames(layout, route.num_frames)),
            route.num_frames,
        )
        raise
    return Recorded(route.num_frames, len(missing), route.length)


@dataclass(frozen=True)
class _Job:
    """Hold the data with which a process can render any frame."""

    world: World
    condition: Condition
    config: RecordConfig
    layout: Layout
    variant: str


def _num_processes(num_frames: int) -> int:
    """One for a few frames, as each process has to build the world first; else two, so that one
    renders while the other stores."""
    return min(2, os.cpu_count() or 1) if num_frames > _FEW_FRAMES else 1


def _render_here(job: _Job, frames: list[int], progress: Progress) -> Generator[int, None, None]:
    if not frames:
        return
    shooting = _shooting(job, progress)
    for index in frames:
        write_shot(job.layout, index, shoot(shooting, index))
        yield index


def _render_in_processes(
    job: _Job, frames: list[int], num: int, progress: Progress
) -> Generator[int, None, None]:
    if job.variant == LLVM:  # the light is traced here, and the processes find it in the cache
        _shooting(job, progress)
    # Not forked: a child of a process in which Mitsuba's threads run would wait for them for ever.
    with ProcessPoolExecutor(
        num, get_context("spawn"), initializer=_start, initargs=(job,)
    ) as pool:
        try:
            with _children_ignore_interrupts():
                futures: list[Future[int]] = [pool.submit(_render_one, index) for index in frames]
            for future in as_completed(futures):
                yield future.result()
        except BrokenProcessPool:
            raise TopolocError(
                "a rendering process was ended from outside (out of memory?); fewer --processes"
                " need less"
            ) from None
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


_job: _Job | None = None
_kept_shooting: Shooting | None = None


def _start(job: _Job) -> None:
    global _job
    _job = job


def _render_one(index: int) -> int:
    """Render one frame in a process of the pool, which keeps the world that it has built."""
    global _kept_shooting
    assert _job is not None
    if _kept_shooting is None:
        _kept_shooting = _shooting(_job)
    write_shot(_job.layout, index, shoot(_kept_shooting, index))
    return index


@contextmanager
def _children_ignore_interrupts() -> Iterator[None]:
    """Processes started meanwhile leave Ctrl-C to this one, which lets them finish their frames."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _shooting(job: _Job, progress: Progress = lambda stage, done, total: None) -> Shooting:
    config = job.config
    use_best_variant(job.variant)
    scene = job.world.build(config.seed, job.condition, config.arrangement)
    return Shooting(
        renderer=Renderer(scene, config.render, job.world.viewpoints(), progress),
        condition=job.condition,
        route=plan_route(job.world.loop, job.world.camera_height, config.route),
        camera=config.camera,
        baseline=config.baseline,
        sensor=config.sensor,
        num_renderings=config.num_renderings,
        lens_drops=config.lens_drops,
        rain=job.world.outdoor,
    )


def _layout(world: World, out: Path, config: RecordConfig) -> Layout:
    depth_factor = world.depth_factor if config.depth else None
    return Layout(
        Path(os.path.abspath(out)),
        config.camera,
        config.baseline,
        config.grey,
        config.jpeg,
        depth_factor,
    )


def _settings(
    world: World, condition: Condition, config: RecordConfig, variant: str, route: Route
) -> dict[str, object]:
    """All that the pictures depend on, for world.json."""
    return {
        "world": world.name,
        "condition": condition.name,
        **{**asdict(config), "camera": config.camera.to_json()},
        "depth_factor": world.depth_factor if config.depth else None,
        "num_frames": route.num_frames,
        "topoloc": version("topoloc"),
        "mitsuba": version("mitsuba"),
        "variant": variant,
    }
