"""Read 7-Scenes (Shotton et al., CVPR 2013): RGB-D sequences of a Kinect in folders ``seq-01/``.

Files are ``frame-000000.color.png``, ``.depth.png`` and ``.pose.txt``. Depth is not registered to
colour, and the poses belong to the depth camera. The recordings contain no calibration. The focal
lengths and the transform between the two cameras are common values of the first Kinect.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from topoloc import Camera, RecordingError, Rigid3
from topoloc.apps.core_names import read_pose_matrix
from topoloc.plugin import DepthImages, Recording, RecordingFormat, list_images, natural_key

EXPECTED_FILES = "frame-*.color.png or .jpg with .pose.txt, or one seq-* folder of these"
DEPTH_CAMERA = Camera.pinhole(640, 480, 585.0, 585.0, 320.0, 240.0)
COLOUR_CAMERA = Camera.pinhole(640, 480, 525.0, 525.0, 320.0, 240.0)
COLOUR_FROM_DEPTH = Rigid3(
    Rigid3.exp(np.array([0.0, 0.0, 0.0, 0.00816, -0.00789, -0.00271])).rotation,
    np.array([-0.02556, 0.00010, 0.00203]),
)
UNITS_PER_METRE = 1000.0
RATE_HZ = 30


def can_open(path: Path) -> bool:
    """Return whether this folder is a sequence of 7-Scenes, or a scene with sequences."""
    return path.is_dir() and any(map(_is_run, (path, *path.glob("seq-*"))))


def open_seven_scenes(path: Path) -> Recording:
    """Open a sequence (``seq-01``), or a scene with a single sequence. Times are frame numbers
    times 1/30 s.

    Raises:
        RecordingError: there is no sequence, or there are several.
        TrajectoryError: a .pose.txt contains no pose.
    """
    run = _find_run(path)
    files = {file.name for file in run.iterdir()}
    colour = list_images(run, ".color")
    numbered = {file.name.partition(".color")[0]: file.name for file in colour}
    with_depth = {name.removesuffix(".depth.png") for name in files if name.endswith(".depth.png")}
    stems = sorted({*numbered, *with_depth}, key=natural_key)
    depth = None
    if with_depth:
        depth_paths = [run / f"{stem}.depth.png" for stem in stems]
        depth = DepthImages(depth_paths, UNITS_PER_METRE, DEPTH_CAMERA, COLOUR_FROM_DEPTH)
    poses = [
        _read_pose(run / f"{stem}.pose.txt") if f"{stem}.pose.txt" in files else None
        for stem in stems
    ]
    t_ns = [_frame_number(run / stem) * 1_000_000_000 // RATE_HZ for stem in stems]
    name = f"{run.resolve().parent.name}/{run.resolve().name}"
    names = [numbered.get(stem, f"{stem}.color{colour[0].suffix}") for stem in stems]
    return Recording(name, run, names, t_ns, poses, COLOUR_CAMERA, depth=depth)


def _is_run(path: Path) -> bool:
    return path.is_dir() and any(path.glob("frame-*.color.*"))


def _find_run(path: Path) -> Path:
    if _is_run(path):
        return path
    runs = sorted(filter(_is_run, path.glob("seq-*")))
    if not runs:
        raise RecordingError(f"{path}: not a run of 7-Scenes, which has {EXPECTED_FILES}")
    if len(runs) > 1:
        raise RecordingError(
            f"{path}: {len(runs)} runs here, name one: {', '.join(run.name for run in runs)}"
        )
    return runs[0]


def _frame_number(path: Path) -> int:
    number = re.fullmatch(r"frame-(\d+)", path.name)
    if number is None:
        raise RecordingError(f"{path}: the name of a frame is frame- and a number")
    return int(number[1])


def _read_pose(path: Path) -> Rigid3 | None:
    """Read world_from_cam of the colour camera of one frame."""
    world_from_depth = read_pose_matrix(path)
    return world_from_depth and world_from_depth @ COLOUR_FROM_DEPTH.inverse()


FORMAT = RecordingFormat(EXPECTED_FILES, can_open, open_seven_scenes)
