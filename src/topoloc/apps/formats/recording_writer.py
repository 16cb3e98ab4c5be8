"""Write frames to a folder that is a valid recording after every frame.

Stereo is in ``left/ right/``, RGB-D in ``rgb/ depth/``, single images in ``images/``, and depth of
a stereo pair in ``depth/``. Images are written atomically, then the time of the frame.
"""

from __future__ import annotations

import json
from contextlib import suppress
from decimal import Decimal
from pathlib import Path
from typing import Any, TextIO

import cv2
import numpy as np
from jaxtyping import Float32, UInt16

from topoloc import Camera, Image, RecordingError, StereoFrame, StereoRig, TopolocError, Trajectory
from topoloc.plugin import write_bytes, write_text

DEPTH_FACTOR = 256.0
"""Units per metre of depth images: steps of 4 mm up to 256 m."""
_MAX_UNITS = 65534  # larger depths are unknown


class RecordingWriter:
    """Writes frames of the same kind. A context manager. Raises TopolocError: the folder is not
    empty, or cannot be created.

    Args:
        folder: a new or empty folder.
        jpeg: quality of JPEG images, 1 to 100; None for PNG.
    """

    def __init__(self, folder: Path, jpeg: int | None = None) -> None:
        self.folder, self.num_frames = folder, 0
        self._is_new = not folder.exists()
        self._jpeg = jpeg
        self._times: TextIO | None = None
        self._truth: TextIO | None = None
        self._subfolders: dict[str, str] = {}
        with TopolocError.at(f"cannot write {folder}", OSError):
            folder.mkdir(exist_ok=True)
            other = next((path.name for path in folder.iterdir()), None)
        if other is not None:
            raise TopolocError(
                f"cannot write {folder}: it is not empty and has {other}; use a new folder"
            )

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(self, *_: object) -> None:
        for file in (self._times, self._truth):
            if file is not None:
                file.close()
        if self._is_new and self.num_frames == 0:  # no frame was written
            with suppress(OSError):
                self.folder.rmdir()

    def write(self, frame: StereoFrame) -> None:
        """Write a frame. Raises RecordingError: the frame is of another kind than the first;
        TopolocError: it cannot be written."""
        images = self._frame_images(frame)
        times = self._times or self._create_folder(frame, images)
        has_pose = frame.world_from_cam is not None
        if set(images) != set(self._subfolders) or (self._truth is not None) != has_pose:
            raise RecordingError(f"{frame.name}: of another kind than the previous frames")
        paths = list[Path]()
        try:
            for kind, image in images.items():
                jpeg = None if kind == "depth" else self._jpeg
                name = f"{self.num_frames:06d}.{'png' if jpeg is None else 'jpg'}"
                paths.append(self.folder / self._subfolders[kind] / name)
                write_bytes(paths[-1], _encode_image(image, jpeg))
            self._write_lines(frame, times)
        except BaseException:  # all of a frame, or nothing
            for path in paths:
                path.unlink(missing_ok=True)
            raise
        self.num_frames += 1

    def _write_lines(self, frame: StereoFrame, times: TextIO) -> None:
        with TopolocError.at(f"cannot write {self.folder}", OSError):
            if self._truth is not None and frame.world_from_cam is not None:
                trajectory = Trajectory([frame.world_from_cam], [frame.t_ns])
                self._truth.write(trajectory.to_tum(header=False))
                self._truth.flush()
            times.write(f"{Decimal(frame.t_ns).scaleb(-9):.9f}\n")
            times.flush()

    def _frame_images(self, frame: StereoFrame) -> dict[str, Image | UInt16[np.ndarray, "h w"]]:
        images: dict[str, Image | UInt16[np.ndarray, "h w"]] = {"left": frame.image}
        if frame.right is not None:
            images["right"] = frame.right
        if frame.depth is not None:
            images["depth"] = _to_depth_units(frame.depth.depth)
        return images

    def _create_folder(self, frame: StereoFrame, images: dict[str, Any]) -> TextIO:
        """Create the folders, the calibration, the truth and the times. Return the latter."""
        own = "left" if "right" in images else "rgb" if "depth" in images else "images"
        self._subfolders = {kind: own if kind == "left" else kind for kind in images}
        with TopolocError.at(f"cannot write {self.folder}", OSError):
            for name in self._subfolders.values():
                (self.folder / name).mkdir()
            if frame.camera is not None:
                calibration = json.dumps(calibration_json(frame, frame.camera), indent=1)
                write_text(self.folder / "camera.json", calibration + "\n")
            if frame.world_from_cam is not None:
                self._truth = (self.folder / "truth.tum").open("x", encoding="utf-8")
                self._truth.write(Trajectory([], []).to_tum())
            self._times = (self.folder / "times.txt").open("x", encoding="utf-8")
            return self._times


def calibration_json(frame: StereoFrame, camera: Camera) -> dict[str, Any]:
    """Return the camera.json of a recording with such frames."""
    calibration = camera.to_json() if frame.rig is None else _rig_json(frame.rig)
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
    """Convert metres to stored units, 0 if unknown or too far."""
    units = np.rint(np.nan_to_num(depth.astype(np.float64), nan=0.0, posinf=0.0) * DEPTH_FACTOR)
    return np.where((units > 0) & (units <= _MAX_UNITS), units, 0).astype(np.uint16)


def _encode_image(pixels: Image | UInt16[np.ndarray, "h w"], jpeg: int | None) -> bytes:
    bgr = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    suffix, settings = ".png", [cv2.IMWRITE_PNG_COMPRESSION, 1]
    if jpeg is not None:
        suffix, settings = ".jpg", [cv2.IMWRITE_JPEG_QUALITY, jpeg]
    is_done, data = cv2.imencode(suffix, bgr, settings)
    if not is_done:
        size = f"{pixels.shape[1]}x{pixels.shape[0]}"
        raise RecordingError(f"an image of {size} pixels cannot be stored as {suffix[1:]}")
    return data.tobytes()
