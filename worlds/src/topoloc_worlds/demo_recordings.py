"""Render the recordings of `topoloc demo`: the lab by day for the map, and the queries.

topoloc ships them (`topoloc/demo/lab`), so the demo needs no renderer.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from topoloc.errors import TopolocError
from topoloc.geometry.camera import Camera
from topoloc.recordings.atomic import write_bytes, write_text
from topoloc_worlds.conditions import find_condition
from topoloc_worlds.noise import fractal_noise, rng_of
from topoloc_worlds.recorder import ZED, RecordConfig, record
from topoloc_worlds.routes import RouteConfig
from topoloc_worlds.worlds import find_world

# PNG would be three times as large; what JPEG costs is small beside what a lap of its own costs.
JPEG_QUALITY = 80
# A lens 1.4 times as long as the mapping camera's, on a sensor of another size.
TELE = Camera.pinhole(800, 600, 665.0, 665.0, 399.5, 299.5)


@dataclass(frozen=True)
class DemoRecording:
    """One recording of the demo: the folder's name, and how it is made."""

    name: str
    world: str
    condition: str
    config: RecordConfig


# Sparse frames, since each is to be shipped; whoever asks sways more than whoever maps.
_MAPPING = RouteConfig(spacing=0.19, corner_radius=find_world("lab").corner_radius)
_ASKING = replace(_MAPPING, spacing=0.26, lateral=0.08, wobble=1.3, shake=0.5)


def _mapping(name: str, route: RouteConfig) -> DemoRecording:
    return DemoRecording(name, "lab", "day", RecordConfig(route=route, jpeg=JPEG_QUALITY))


def _asking(
    name: str, condition: str, arrangement: int, route: RouteConfig, camera: Camera = ZED
) -> DemoRecording:
    config = RecordConfig(
        arrangement=arrangement, route=route, camera=camera, baseline=None, jpeg=JPEG_QUALITY
    )
    return DemoRecording(name, "lab", condition, config)


def _elsewhere(name: str, condition: str, spacing: float, num_frames: int) -> DemoRecording:
    """Single pictures from all round another world."""
    walk = replace(find_world(name).route(), spacing=spacing, num_frames=num_frames, seed=9)
    return DemoRecording(
        name, name, condition, RecordConfig(route=walk, baseline=None, jpeg=JPEG_QUALITY)
    )


RECORDINGS = (
    _mapping("map_lap1", replace(_MAPPING, seed=1)),
    _mapping("map_lap2", replace(_MAPPING, seed=2, lateral=0.15, start=0.1)),
    _asking("day", "day", 0, replace(_ASKING, seed=3)),
    _asking("night", "night", 1, replace(_ASKING, seed=4)),
    _asking("other_camera", "day", 1, replace(_ASKING, seed=5, spacing=0.45), TELE),
    _elsewhere("corridor", "day", 9.0, 8),
    _elsewhere("street", "cloudy", 90.0, 8),
)


def render_recordings(
    folder: Path, progress: Callable[[str, int, int], None] = lambda stage, done, total: None
) -> None:
    """Render all recordings of the demo into `folder`. An interrupted run is resumed.

    Raises:
        MissingExtraError: Mitsuba is not installed.
        TopolocError: the folder cannot be written, or holds something else.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TopolocError(f"cannot write {folder}: {error.strerror}") from error
    for recording in RECORDINGS:
        stages = {
            "frames": f"rendering {recording.name.replace('_', ' ')}",
            "light": f"light for {recording.name.replace('_', ' ')}",
        }
        record(
            find_world(recording.world),
            find_condition(recording.condition),
            folder / recording.name,
            recording.config,
            progress=lambda stage, done, total, stages=stages: progress(stages[stage], done, total),
        )
    draw_pictures_of_nothing(folder / "pictures_of_nothing")


def draw_pictures_of_nothing(folder: Path) -> None:
    """Pictures that show no place at all, with a camera.json: black, white, noise of one pixel and
    of clouds, stripes.

    Raises:
        TopolocError: the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TopolocError(f"cannot write {folder}: {error.strerror}") from error
    for name, picture in _pictures_of_nothing().items():
        write_bytes(folder / f"{name}.png", cv2.imencode(".png", picture)[1].tobytes())
    write_text(folder / "camera.json", json.dumps(ZED.to_json()) + "\n")


def _pictures_of_nothing() -> dict[str, UInt8[np.ndarray, "h w"]]:
    shape = (ZED.height, ZED.width)
    rng = rng_of(0, "nothing")
    clouds = 128.0 + 45.0 * fractal_noise(rng, shape, 60.0)
    stripes = 128.0 + 90.0 * np.sin(np.arange(ZED.width) / 5.0)[None, :].repeat(ZED.height, axis=0)
    levels = {"clouds": clouds, "noise": rng.normal(128.0, 40.0, shape), "stripes": stripes}
    drawn = {
        name: np.clip(picture, 0.0, 255.0).astype(np.uint8) for name, picture in levels.items()
    }
    return {"black": np.zeros(shape, np.uint8), "white": np.full(shape, 255, np.uint8), **drawn}
