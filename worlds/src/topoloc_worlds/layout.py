"""Define the files of a rendered recording: paths, contents, and the frames already written.

A stereo recording has KITTI's layout (``image_2/ image_3/``, grey ``image_0/ image_1/``; depth
images in ``depth_2/`` or ``depth_0/``). A recording of a single camera is a plain folder
(``images/``; with depth ``rgb/ depth/``) with its ``camera.json``. Times, calibration and ground
truth cover the whole recording from the start, so opening an incomplete recording raises an error.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, UInt16

from topoloc.errors import TopolocError
from topoloc.geometry.camera import Camera
from topoloc.recordings.atomic import write_bytes, write_text
from topoloc.recordings.frame import Image, to_grey
from topoloc.recordings.trajectory import Trajectory
from topoloc_worlds.shots import Shot

SETTINGS = "world.json"
_MADE_BY = "topoloc simulate"
_OURS = ("image_0", "image_1", "image_2", "image_3", "depth_0", "depth_2", "images", "rgb", "depth")
_HEADERS = ("times.txt", "truth.tum", "calib.txt", "camera.json", SETTINGS)
_UNKNOWN_DEPTH = 0


@dataclass(frozen=True)
class Layout:
    """Hold the paths and formats of a recording's images.

    Attributes:
        folder: folder of the recording.
        baseline: metres to the right camera; None without one.
        jpeg: quality of JPEG files, 1 to 100; None for PNG.
        depth_factor: units a metre of depth images; None without them.
    """

    folder: Path
    camera: Camera
    baseline: float | None
    grey: bool = False
    jpeg: int | None = None
    depth_factor: float | None = None

    @property
    def left(self) -> str:
        if self.baseline is not None:
            return "image_0" if self.grey else "image_2"
        return "images" if self.depth_factor is None else "rgb"

    @property
    def right(self) -> str | None:
        return None if self.baseline is None else "image_1" if self.grey else "image_3"

    @property
    def depth(self) -> str | None:
        if self.depth_factor is None:
            return None
        return "depth" if self.baseline is None else "depth_0" if self.grey else "depth_2"

    def pictures(self, index: int) -> dict[str, Path]:
        """Return the files of one frame: "left", and "right" and "depth" if the recording has
        them."""
        suffix = "png" if self.jpeg is None else "jpg"
        files = {"left": self.folder / self.left / f"{index:06d}.{suffix}"}
        if self.right is not None:
            files["right"] = self.folder / self.right / f"{index:06d}.{suffix}"
        if self.depth is not None:
            files["depth"] = self.folder / self.depth / f"{index:06d}.png"
        return files


def prepare(
    layout: Layout, settings: dict[str, object], trajectory: Trajectory, overwrite: bool
) -> None:
    """Make the folders and write all but the pictures, or hold that a recording begun before is
    this very one.

    Raises:
        TopolocError: the folder holds something else, or a recording with other settings (unless
            `overwrite`, which removes it), or it cannot be written.
    """
    folder = layout.folder
    try:
        if _is_begun(folder):
            before = _read_settings(folder / SETTINGS)
            if overwrite:
                _remove(folder)
            elif different := _differences(before, json.loads(json.dumps(settings))):
                raise TopolocError(
                    f"{folder} was begun with other settings ({'; '.join(different[:5])}); name"
                    " another folder, or give --overwrite"
                )
        folder.mkdir(parents=True, exist_ok=True)
        write_text(
            folder / SETTINGS, json.dumps({"made_by": _MADE_BY, **settings}, indent=1) + "\n"
        )
        for name in (layout.left, layout.right, layout.depth):
            if name is not None:
                (folder / name).mkdir(exist_ok=True)
                _remove_parts(folder / name)
    except OSError as error:
        raise TopolocError(f"cannot write {error.filename or folder}: {error.strerror}") from error
    assert trajectory.t_ns is not None
    write_text(
        folder / "times.txt", "".join(f"{Decimal(t).scaleb(-9):.9f}\n" for t in trajectory.t_ns)
    )
    trajectory.write_tum(folder / "truth.tum")
    if layout.baseline is not None:
        write_text(folder / "calib.txt", _calib(layout.camera, layout.baseline))
    else:
        depth = {} if layout.depth_factor is None else {"depth_factor": layout.depth_factor}
        write_text(folder / "camera.json", json.dumps({**layout.camera.to_json(), **depth}) + "\n")


def missing_frames(layout: Layout, num_frames: int) -> list[int]:
    """Return the frames with a missing file."""
    return [
        i
        for i in range(num_frames)
        if not all(path.is_file() for path in layout.pictures(i).values())
    ]


def write_shot(layout: Layout, index: int, shot: Shot) -> None:
    """Write the pictures of one frame, each whole or not at all. Raises TopolocError."""
    for kind, path in layout.pictures(index).items():
        if kind == "depth":
            assert layout.depth_factor is not None
            data = _encoded(_depth_units(shot.depth, layout.depth_factor), None)
        else:
            image = shot.left if kind == "left" or shot.right is None else shot.right
            data = _encoded(to_grey(image) if layout.grey else image, layout.jpeg)
        write_bytes(path, data)


def _encoded(image: Image | UInt16[np.ndarray, "h w"], jpeg: int | None) -> bytes:
    pixels = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    suffix, settings = (
        (".png", [cv2.IMWRITE_PNG_COMPRESSION, 3])
        if jpeg is None
        else (".jpg", [cv2.IMWRITE_JPEG_QUALITY, jpeg])
    )
    done, data = cv2.imencode(suffix, pixels, settings)
    if not done:
        raise TopolocError(
            f"a picture of {pixels.shape[1]}x{pixels.shape[0]} pixels cannot be stored as"
            f" {suffix[1:]}"
        )
    return data.tobytes()


def _depth_units(
    depth: Float32[np.ndarray, "h w"], depth_factor: float
) -> UInt16[np.ndarray, "h w"]:
    """Return depth in its stored format. Depth beyond 16 bits and sky are stored as unknown."""
    units = np.rint(np.nan_to_num(depth.astype(np.float64), nan=0.0, posinf=0.0) * depth_factor)
    return np.where((units > 0) & (units < 65535), units, _UNKNOWN_DEPTH).astype(np.uint16)


def _calib(camera: Camera, baseline: float) -> str:
    """KITTI's calib.txt: P0 and P2 are the left camera, P1 and P3 the right one."""
    rows = []
    for number in range(4):
        shift = -camera.fx * baseline if number % 2 else 0.0
        matrix = [
            camera.fx,
            0.0,
            camera.cx,
            shift,
            0.0,
            camera.fy,
            camera.cy,
            0.0,
            0.0,
            0.0,
            1.0,
            0.0,
        ]
        rows.append(f"P{number}: " + " ".join(f"{value:.12e}" for value in matrix))
    return "\n".join(rows) + "\n"


def _is_begun(folder: Path) -> bool:
    """Return whether a recording of this package is here.

    Raises:
        TopolocError: the folder holds something else.
    """
    if not folder.exists():
        return False
    if not folder.is_dir():
        raise TopolocError(f"cannot write {folder}: it is a file")
    if (folder / SETTINGS).is_file():
        return True
    if any(not path.name.endswith(".part") for path in folder.iterdir()):
        raise TopolocError(f"cannot write {folder}: it holds other files; name a new folder")
    return False


def _read_settings(path: Path) -> dict[str, object]:
    try:
        settings = json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        settings = None
    if not isinstance(settings, dict) or settings.pop("made_by", None) != _MADE_BY:
        raise TopolocError(f"{path}: not written by {_MADE_BY}; name another folder")
    return settings


def _differences(before: object, now: object, name: str = "") -> list[str]:
    """Describe each difference between two settings."""
    if isinstance(before, dict) and isinstance(now, dict):
        keys = [*before, *(key for key in now if key not in before)]
        below = [
            _differences(before.get(key), now.get(key), f"{name}.{key}" if name else key)
            for key in keys
        ]
        return [text for texts in below for text in texts]
    return [] if before == now else [f"{name} was {json.dumps(before)}, now {json.dumps(now)}"]


def _remove(folder: Path) -> None:
    """Remove the files of a recording, and nothing else."""
    for name in _OURS:
        if (folder / name).is_dir():
            shutil.rmtree(folder / name)
    for name in _HEADERS:
        (folder / name).unlink(missing_ok=True)


def _remove_parts(folder: Path) -> None:
    """Remove partly written files of a killed run."""
    for path in folder.glob(".*.part"):
        path.unlink(missing_ok=True)
