"""Map the rendered room of `tiny_world`, and render new images of it, each once per test run."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from made_once import once_a_run
from tiny_world import CAMERA, path_pose, render, room, tum_line, write_stereo_recording
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.map_facts.map_building import build_map
from topoloc.mapping.build import BuildConfig
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.open import open_sequence


@once_a_run
def recorded_room(folder: Path) -> Path:
    """Return the recording `tiny_recording`."""
    return write_stereo_recording(folder)


@once_a_run
def built_room(recording: Path) -> TopoMetricMap:
    """Return the map of the recording `tiny_recording`, of SURF alone."""
    return build_map(open_sequence(recording), BuildConfig(other_kinds=()))


@once_a_run
def room_of_two_kinds(recording: Path) -> TopoMetricMap:
    """Return a map of every other pair, of SURF and SIFT."""
    return build_map(open_sequence(f"{recording}@0::2"), BuildConfig(other_kinds=("sift",)))


@cache
def unseen_views(seed: int = 0, step: float = 1.5) -> list[tuple[np.ndarray, Rigid3]]:
    """Return grey images of CAMERA between the frames of the recording, with world_from_cam.
    Another seed is another world."""
    panels = room(seed)
    indices = np.arange(0.5, 13.0, step)
    return [
        (render(panels, path_pose(index), noise_seed=900 + k)[0], path_pose(index))
        for k, index in enumerate(indices)
    ]


def write_pictures(folder: Path, views: list[tuple[np.ndarray, Rigid3]]) -> Path:
    """Write the views as a folder of images with camera.json, times and truth, and
    return `folder`."""
    folder.mkdir(parents=True)
    for number, (picture, _) in enumerate(views):
        assert cv2.imwrite(str(folder / f"view{number:02d}.png"), picture)
    (folder / "camera.json").write_text(json.dumps(CAMERA.to_json()))
    (folder / "times.txt").write_text(
        "".join(f"{number / 10:.9f}\n" for number in range(len(views)))
    )
    (folder / "truth.tum").write_text(
        "".join(tum_line(number, pose) + "\n" for number, (_, pose) in enumerate(views))
    )
    return folder
