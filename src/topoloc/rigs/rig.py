"""Model a rig: cameras that are fixed on one body, and its file `rig.json`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from msgspec import Struct

from topoloc.errors import CalibrationError, QueryError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.geometry.transform_consensus import diagonal_covariance
from topoloc.json_data import NonNegative, OneLine, decode_json
from topoloc.recordings.camera_files import read_camera_json
from topoloc.recordings.frame import Image, StereoFrame
from topoloc.recordings.text_files import read_text

_SIGMAS = ("position_sigma_m", "rotation_sigma_deg")


@dataclass(frozen=True, repr=False)
class RigCamera(OneLine):
    """Hold the mounting of a camera (metres) and its model, None: not calibrated. The sigmas are
    root mean square errors of the mounting."""

    rig_from_cam: Rigid3
    camera: Camera | None = None
    position_sigma_m: float = 0.0
    rotation_sigma_deg: float = 0.0

    @property
    def covariance(self) -> Float[np.ndarray, "6 6"]:
        """Return that of the mounting, about each axis alike (m, rad)."""
        return diagonal_covariance(self.position_sigma_m, self.rotation_sigma_deg) / 3.0


@dataclass(frozen=True, repr=False)
class Rig(OneLine):
    """Hold the cameras of a rig by name.

    The frame of the rig is any that is fixed to its body, such as that of one camera.
    """

    cameras: Mapping[str, RigCamera]

    def __post_init__(self) -> None:
        """Raise CalibrationError if there is no camera."""
        if not self.cameras:
            raise CalibrationError("a rig needs at least one camera")

    @staticmethod
    def read(path: str | Path) -> Rig:
        """Read a rig.json: ``{"cameras": {"front": {"rig_from_cam": ..., "camera": ...}, ...}}``.

        A mounting is `rig_from_cam` or `cam_from_rig`: rows of a 3x4 or 4x4 matrix, or translation
        (metres) and quat_wxyz. `camera` is the content of a camera.json, or the path of one from
        here; without it the camera is not calibrated. `position_sigma_m` and `rotation_sigma_deg`
        are the uncertainty of a mounting, 0 by default.

        Raises:
            CalibrationError: the file is missing or has another content.
        """
        path = Path(path)
        text = read_text(path, CalibrationError, "no such rig file")
        data = decode_json(text, _RigFile, CalibrationError, str(path))
        with CalibrationError.at(path):
            cameras = {name: one.mounted(name, path.parent) for name, one in data.cameras.items()}
            return Rig(cameras)

    def to_json(self) -> dict[str, Any]:
        """Return the content of a rig.json."""
        return {
            "cameras": {
                name: {"rig_from_cam": one.rig_from_cam.to_json()}
                | ({} if one.camera is None else {"camera": one.camera.to_json()})
                | {key: of for key in _SIGMAS if (of := getattr(one, key))}
                for name, one in self.cameras.items()
            }
        }


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class RigFrame(StereoFrame):
    """Hold the images of a rig at one instant by the names of their cameras.

    `image` and `camera` are those of one of them. `world_from_cam` is the pose of the rig.
    """

    mounted: Rig
    images: Mapping[str, Image]


class _MountedCamera(Struct, frozen=True, forbid_unknown_fields=True):
    rig_from_cam: Rigid3 | None = None
    cam_from_rig: Rigid3 | None = None
    camera: dict[str, Any] | str | None = None
    position_sigma_m: NonNegative = 0.0
    rotation_sigma_deg: NonNegative = 0.0

    def mounted(self, name: str, folder: Path) -> RigCamera:
        """Raises CalibrationError: no mounting or two, or the camera's model cannot be read."""
        if (self.rig_from_cam is None) == (self.cam_from_rig is None):
            raise CalibrationError(f"{name}: a camera has either rig_from_cam or cam_from_rig")
        mounting = self.rig_from_cam
        if mounting is None:
            assert self.cam_from_rig is not None
            mounting = self.cam_from_rig.inverse()
        camera = self.camera
        if isinstance(camera, str):
            camera = read_camera_json(folder / camera).camera
        elif camera is not None:
            camera = Camera.from_json(camera, name)
        return RigCamera(mounting, camera, self.position_sigma_m, self.rotation_sigma_deg)


class _RigFile(Struct, frozen=True, forbid_unknown_fields=True):
    cameras: dict[str, _MountedCamera]


def cut_panorama(
    panorama: UInt8[np.ndarray, "h w *channels"],
) -> tuple[Rig, dict[str, UInt8[np.ndarray, "side side *channels"]]]:
    """Return an equirectangular panorama (360 x 180 degrees) as a rig of four pinholes without
    baseline, and their images of 90 degrees.

    The rig's axes are those of COLMAP's EQUIRECTANGULAR camera: z to the centre of the image, x to
    the right, y down.

    Raises:
        QueryError: the image is not twice as wide as high.
    """
    height, width = panorama.shape[:2]
    if abs(width - 2 * height) > 2:
        raise QueryError(
            f"a panorama of 360 x 180 degrees is twice as wide as high, not {width}x{height}"
        )
    side = round(width / math.pi)  # the pixels of its centre have the size of the panorama's
    camera = Camera.pinhole(side, side, side / 2, side / 2, (side - 1) / 2, (side - 1) / 2)
    names = ("ahead", "right", "behind", "left")
    turns = {name: exp_so3(np.array([0.0, k * math.pi / 2, 0.0])) for k, name in enumerate(names)}
    rows, columns = np.indices((side, side))
    rays_cam = camera.rays_from_img(np.column_stack([columns.ravel(), rows.ravel()]).astype(float))
    wide = cv2.copyMakeBorder(panorama, 0, 0, 2, 2, cv2.BORDER_WRAP)
    images = dict[str, np.ndarray]()
    for name, rotation in turns.items():
        x, y, z = (rays_cam @ rotation.T).T
        column = (np.arctan2(x, z) / (2 * math.pi) + 0.5) * width + 1.5
        row = (np.arctan2(y, np.hypot(x, z)) / math.pi + 0.5) * height - 0.5
        column, row = (one.astype(np.float32).reshape(side, side) for one in (column, row))
        images[name] = cv2.remap(wide, column, row, cv2.INTER_LINEAR)
    centre = np.zeros(3)
    return Rig({name: RigCamera(Rigid3(r, centre), camera) for name, r in turns.items()}), images
