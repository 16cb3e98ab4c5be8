"""Compute the poses of single images of one place, in any order and without any pose, by structure
from motion: features, pairs and their verification are those of topoloc, the mapper is pycolmap's
(the extra `colmap`).

Lengths have an arbitrary unit, which `scale.py` finds. Matches, snapshots of the mapper and its
result are files of a work folder: a stopped run continues, and a finished one is read again.
"""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from topoloc import (
    Camera,
    MissingExtraError,
    RecordingError,
    Rigid3,
    StereoFrame,
    StereoSequence,
    UncalibratedCamera,
)
from topoloc.apps.core_names import SequenceView, match_views, read_left_frame

MIN_IMAGES = 6
_MAX_NAMES = 4  # of images that a message lists
Progress = Callable[[str, int, int], object]


@dataclass(frozen=True, eq=False, repr=False)
class PosedView(SequenceView):
    """Show all frames of a recording with poses (world_from_cam) and the cameras that were found.
    Frames with a calibration keep it."""

    cameras: Sequence[Camera | None] = ()

    def read_frame(self, row: int) -> StereoFrame:
        """Read one frame. Raises as the base sequence."""
        return self._with_camera(super().read_frame(row), row)

    def read_left_frame(self, index: int) -> StereoFrame:
        """Read one frame without its right or depth image. Raises as the base sequence."""
        frame = read_left_frame(self.base, self.indices[index])
        return self._with_camera(replace(frame, world_from_cam=self.poses[index]), index)

    def _with_camera(self, frame: StereoFrame, row: int) -> StereoFrame:
        return frame if frame.camera is not None else replace(frame, camera=self.cameras[row])


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """Hold what an image sees of the reconstruction: pixels and depths in units (z of the camera),
    without the points that it shares with no other image."""

    points_img: Float[np.ndarray, "n 2"]
    depths: Float[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Hold recordings with poses in an arbitrary unit. `seen` has one entry for each image of all
    recordings, in their order. `is_fitted`: a camera had no calibration."""

    sequences: list[PosedView]
    seen: list[SeenPoints]
    is_fitted: bool = False


def reconstruct(
    sequences: Sequence[StereoSequence],
    work: Path,
    progress: Progress,
    warn: Callable[[str], object],
) -> Reconstruction:
    """Compute the poses of all images of recordings of one place. Right and depth images are not
    used.

    Args:
        work: folder of this call's files; one of an earlier call with the same images continues it.
        warn: called with the images that have no pose.

    Raises:
        MissingExtraError: pycolmap is not installed.
        RecordingError: there are too few images, they show no common place, or were all taken from
            one position; or the mapper ended early.
        CalibrationError, UnreadableImageError: an image cannot be read.
    """
    name, total = sequences[0].name, sum(map(len, sequences))
    if importlib.util.find_spec("pycolmap") is None:
        need = f"{name}: images need poses (--trajectory FILE), or pycolmap to compute them"
        with MissingExtraError.on_import(need, "colmap"):
            raise ImportError(name="pycolmap")
    if total < MIN_IMAGES:
        raise RecordingError(
            f"{name}: {total} images are too few to compute their poses; take at least"
            f" {MIN_IMAGES}, better 30 or more, each with most of the one before in view"
        )
    work.mkdir(parents=True, exist_ok=True)
    if not (work / "poses.npz").is_file():
        if not (work / "views.npz").is_file():
            _write_views(sequences, work, progress)
        _run_mapper(name, total, work, progress)
    found = dict(np.load(work / "poses.npz"))
    for path in (work / "views.npz", *work.glob("database.db*")):
        path.unlink(missing_ok=True)
    _report_parts(sequences, found["parts"], warn)
    return _read_result(sequences, found)


def _write_views(sequences: Sequence[StereoSequence], work: Path, progress: Progress) -> None:
    graph = match_views(sequences, progress)
    if not graph.pairs:
        raise RecordingError(
            f"{sequences[0].name}: no two of {len(graph.cameras)} images show the same place; take"
            " each with most of the one before in view, in light and without blur"
        )
    recordings = [k for k, one in enumerate(sequences) for _ in range(len(one))]
    keys = list(zip(recordings, graph.cameras, strict=True))
    numbers = {key: number for number, key in enumerate(dict.fromkeys(keys), start=1)}
    arrays = {
        "cameras": json.dumps([_describe_camera(camera) for _, camera in numbers]),
        "camera_of_image": np.array([numbers[key] for key in keys]),
        "num_points": np.array([len(one) for one in graph.points_img]),
        "points_img": np.concatenate(graph.points_img),
        "pairs": np.array([(one.first, one.second) for one in graph.pairs]),
        "num_matches": np.array([len(one.features) for one in graph.pairs]),
        "matches": np.concatenate([one.features for one in graph.pairs]).astype(np.uint32),
    }
    part = work / "views.part.npz"
    np.savez(part, **arrays)
    part.rename(work / "views.npz")


def _describe_camera(camera: Camera | UncalibratedCamera) -> dict[str, Any]:
    """Return COLMAP's camera. One without calibration is fitted: focal length and one coefficient
    of radial distortion."""
    is_known = isinstance(camera, Camera)
    if isinstance(camera, Camera):
        model, width, height, params = camera.to_colmap()
    else:
        width, height = camera.width, camera.height
        focal = float(np.sqrt(camera.min_focal * camera.max_focal))
        model, params = "SIMPLE_RADIAL", (focal, width / 2, height / 2, 0.0)
    has_focal = is_known or camera != UncalibratedCamera.unknown(width, height)
    colmap = {"model": model, "width": width, "height": height, "params": list(params)}
    return {"colmap": colmap, "is_known": is_known, "has_focal": has_focal}


def _run_mapper(name: str, total: int, work: Path, progress: Progress) -> None:
    command = [sys.executable, "-m", "topoloc.apps.reconstruction.mapper", str(work)]
    with (
        (work / "errors.txt").open("w+", encoding="utf-8") as errors,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True) as child,
    ):
        try:
            assert child.stdout is not None
            for line in child.stdout:
                if line.strip().isdigit():
                    progress("poses", min(int(line), total), total)
        except BaseException:
            child.kill()
            raise
        child.wait()
        errors.seek(0)
        last = next(reversed(errors.read().strip().splitlines()), "")
    if child.returncode:
        raise RecordingError(
            f"{name}: the mapper of pycolmap ended early ({last[:120] or child.returncode}); run"
            " the command again to continue, with fewer images if memory was too small"
        )


def _report_parts(
    sequences: Sequence[StereoSequence], parts: np.ndarray, warn: Callable[[str], object]
) -> None:
    """Warn of images without a pose. Raises RecordingError: hardly any has one."""
    name, total = sequences[0].name, len(parts)
    names = np.array([one for sequence in sequences for one in sequence.names])
    num = np.count_nonzero(parts == 0)
    if num < MIN_IMAGES:
        raise RecordingError(
            f"{name}: only {num} of {total} images could be joined: take more of one place, each"
            " with most of the one before in view, and walk between them, as images from one"
            " position show no depth"
        )
    for part in range(1, parts.max() + 1):
        other = names[parts == part]
        warn(
            f"{name}: {len(other)} of {total} images ({_list(other)}) are of another place or share"
            " no view with the rest, and are left out: map them alone, or add images between"
        )
    if len(alone := names[parts < 0]):
        warn(
            f"{name}: {len(alone)} of {total} images are not registered and left out"
            f" ({_list(alone)}): blurred, without texture, or no other shows their place"
        )


def _list(names: np.ndarray) -> str:
    return ", ".join(names[:_MAX_NAMES].tolist()) + " ..." * (len(names) > _MAX_NAMES)


def _read_result(sequences: Sequence[StereoSequence], found: dict[str, Any]) -> Reconstruction:
    poses, cameras = list[Rigid3 | None](), list[Camera | None]()
    for part, matrix, text in zip(
        found["parts"].tolist(), found["cam_from_world"], found["cameras"].tolist(), strict=True
    ):
        is_used = part == 0
        poses.append(Rigid3.from_matrix(matrix).inverse() if is_used else None)
        model, width, height, params = json.loads(text) if is_used else ("", 0, 0, [])
        size = width, height
        cameras.append(Camera.from_colmap(model, *size, tuple(params)) if is_used else None)
    starts = np.cumsum([0, *map(len, sequences)]).tolist()
    views = [
        PosedView(one, list(range(len(one))), poses[start:stop], cameras=cameras[start:stop])
        for one, (start, stop) in zip(sequences, pairwise(starts), strict=True)
    ]
    seen = [found["seen"][found["seen"][:, 0] == row, 1:] for row in range(len(poses))]
    points = [SeenPoints(one[:, :2] - 0.5, one[:, 2]) for one in seen]
    is_fitted = any(read_left_frame(one, 0).camera is None for one in sequences)
    return Reconstruction(views, points, is_fitted)
