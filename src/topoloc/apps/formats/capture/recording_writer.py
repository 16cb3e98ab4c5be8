"""Frames become a recording on disk while they come: a plain folder, readable after every frame.

Stereo lies in ``left/ right/``, RGB-D in ``rgb/ depth/``, single pictures in ``images/``; depth of
a stereo pair in ``depth/`` beside it. Each picture is whole or not there; the line of its time
follows once all pictures of the frame are.
"""

from __future__ import annotations

import json
from contextlib import suppress
from decimal import Decimal
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

import cv2
import numpy as np
from jaxtyping import Float32, UInt16

from topoloc import (
    Image,
    RecordingError,
    StereoFrame,
    StereoRig,
    TopolocError,
    Trajectory,
    tum_text,
)
from topoloc.plugin import write_bytes, write_text

DEPTH_FACTOR = 256.0
"""Units a metre of depth pictures: 4 mm steps up to 256 m."""
_MAX_UNITS = 65534  # units; what is further is unknown


class RecordingWriter:
    """Writes frames one by one; all are of the same kind as the first. A context manager.

    Args:
        folder: a new folder, or an empty one.
        jpeg: quality of JPEG pictures, 1 to 100; None for PNG.

    Raises:
        TopolocError: the folder holds something, or cannot be made.
    """

    def __init__(self, folder: Path, jpeg: int | None = None) -> None:
        self.folder, self.num_frames = folder, 0
        self._is_new = not folder.exists()
        self._jpeg = jpeg
        self._times: TextIO | None = None
        self._truth: TextIO | None = None
        self._subfolders: dict[str, str] = {}
        try:
            folder.mkdir(exist_ok=True)
            other = next((path.name for path in folder.iterdir()), None)
        except OSError as error:
            raise TopolocError(f"cannot write {folder}: {error.strerror}") from None
        if other is not None:
            raise TopolocError(
                f"cannot write {folder}: it holds other things, such as {other}; name a new folder"
            )

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for file in (self._times, self._truth):
            if file is not None:
                file.close()
        if self._is_new and self.num_frames == 0:  # nothing came, or nothing could be written
            with suppress(OSError):
                self.folder.rmdir()

    def write(self, frame: StereoFrame) -> None:
        """Raises:
        RecordingError: the frame is of another kind than the first.
        TopolocError: it cannot be written.
        """
        images = self._frame_images(frame)
        if self._times is None:
            self._create_folder(frame, images)
        if set(images) != set(self._subfolders) or (self._truth is None) != (
            frame.world_from_cam is None
        ):
            raise RecordingError(f"{frame.name}: of another kind than the frames before")
        suffix = "png" if self._jpeg is None else "jpg"
        paths = {
            kind: (
                self.folder
                / self._subfolders[kind]
                / f"{self.num_frames:06d}.{'png' if kind == 'depth' else suffix}"
            )
            for kind in images
        }
        try:
            for kind, path in paths.items():
                write_bytes(
                    path, _encode_image(images[kind], None if kind == "depth" else self._jpeg)
                )
            self._write_lines(frame)
        except BaseException:  # a frame is whole, or none of it is there
            for path in paths.values():
                path.unlink(missing_ok=True)
            raise
        self.num_frames += 1

    def _write_lines(self, frame: StereoFrame) -> None:
        assert self._times is not None
        try:
            if self._truth is not None and frame.world_from_cam is not None:
                trajectory = Trajectory([frame.world_from_cam], [frame.t_ns])
                self._truth.write(tum_text(trajectory, header=False))
                self._truth.flush()
            self._times.write(f"{Decimal(frame.t_ns).scaleb(-9):.9f}\n")
            self._times.flush()
        except OSError as error:
            raise TopolocError(f"cannot write {self.folder}: {error.strerror}") from None

    def _frame_images(self, frame: StereoFrame) -> dict[str, Image | UInt16[np.ndarray, "h w"]]:
        images: dict[str, Image | UInt16[np.ndarray, "h w"]] = {"left": frame.image}
        if frame.right is not None:
            images["right"] = frame.right
        if frame.depth is not None:
            images["depth"] = _to_depth_units(frame.depth.depth)
        return images

    def _create_folder(self, frame: StereoFrame, images: dict[str, Any]) -> None:
        """The folders, the calibration, and the files that grow."""
        own = "left" if "right" in images else "rgb" if "depth" in images else "images"
        self._subfolders = {kind: own if kind == "left" else kind for kind in images}
        try:
            for name in self._subfolders.values():
                (self.folder / name).mkdir()
            if frame.camera is not None:
                calibration = json.dumps(calibration_json(frame), indent=1)
                write_text(self.folder / "camera.json", calibration + "\n")
            if frame.world_from_cam is not None:
                self._truth = (self.folder / "truth.tum").open("x", encoding="utf-8")
                self._truth.write(tum_text(Trajectory([], [])))
            self._times = (self.folder / "times.txt").open("x", encoding="utf-8")
        except OSError as error:
            raise TopolocError(f"cannot write {self.folder}: {error.strerror}") from None


def calibration_json(frame: StereoFrame) -> dict[str, Any]:
    """The camera.json of a recording with such frames, which have a camera."""
    assert frame.camera is not None
    calibration = frame.camera.to_json() if frame.rig is None else _rig_json(frame.rig)
    return calibration if frame.depth is None else calibration | {"depth_factor": DEPTH_FACTOR}


def _rig_json(rig: StereoRig) -> dict[str, Any]:
    if rig.is_rectified:
        return rig.left.to_json() | {"baseline": rig.baseline}
    return {
        "left": rig.left.to_json(),
        "right": rig.right.to_json(),
        "right_from_left": rig.right_from_left.matrix().tolist(),
    }


def _to_depth_units(depth: Float32[np.ndarray, "h w"]) -> UInt16[np.ndarray, "h w"]:
    """As it is stored; 0 where unknown or too far."""
    units = np.rint(np.nan_to_num(depth.astype(np.float64), nan=0.0, posinf=0.0) * DEPTH_FACTOR)
    return np.where((units > 0) & (units <= _MAX_UNITS), units, 0).astype(np.uint16)


def _encode_image(pixels: Image | UInt16[np.ndarray, "h w"], jpeg: int | None) -> bytes:
    bgr = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    suffix, settings = (
        (".png", [cv2.IMWRITE_PNG_COMPRESSION, 1])
        if jpeg is None
        else (".jpg", [cv2.IMWRITE_JPEG_QUALITY, jpeg])
    )
    is_done, data = cv2.imencode(suffix, bgr, settings)
    if not is_done:
        raise RecordingError(
            f"a picture of {pixels.shape[1]}x{pixels.shape[0]} pixels cannot be stored as"
            f" {suffix[1:]}"
        )
    return data.tobytes()
