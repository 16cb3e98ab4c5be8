"""Define the frames of a recording, independent of its format: stereo pair, RGB-D or single
image."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import StereoRig
from topoloc.geometry.rigid import Rigid3

Image = UInt8[np.ndarray, "h w"] | UInt8[np.ndarray, "h w 3"]


def to_grey(image: Image) -> UInt8[np.ndarray, "h w"]:
    """Convert an image to grey with the luma weights of Rec. 601. A grey image is returned
    unchanged."""
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


@dataclass(frozen=True, eq=False)
class DepthImage:
    """Hold depth along z in metres, in pixels of its own camera. Unknown depth is NaN. It is
    registered if `cam_from_depth` is the identity."""

    depth: Float32[np.ndarray, "h w"]
    camera: Camera
    cam_from_depth: Rigid3 = field(default_factory=Rigid3.identity)


@dataclass(frozen=True, eq=False)
class StereoFrame:
    """Hold a frame of a recording.

    `image` is the left (or colour) image: grey (H, W) or RGB (H, W, 3), uint8, taken by `camera`. A
    stereo frame has `right` and `rig`, an RGB-D frame has `depth`, a single image has neither.
    `world_from_cam` is the pose of the image's camera, from ground truth or an attached trajectory.
    `exif_focal_px` (pixels) is the focal length in the file of an image without a camera model.
    """

    name: str
    t_ns: int
    image: Image
    camera: Camera | None
    right: Image | None = None
    rig: StereoRig | None = None
    depth: DepthImage | None = None
    world_from_cam: Rigid3 | None = None
    exif_focal_px: float | None = None

    def __repr__(self) -> str:
        size = f"{self.image.shape[1]} x {self.image.shape[0]}"
        parts = {"right": self.right, "depth": self.depth, "pose": self.world_from_cam}
        held = [name for name, part in parts.items() if part is not None]
        return f"StereoFrame({self.name!r}, {self.t_ns / 1e9:.3f} s, {', '.join([size, *held])})"


@runtime_checkable
class StereoSequence(Protocol):
    """A recording that is read lazily. Only names, times and poses are in memory until a frame is
    accessed."""

    @property
    def name(self) -> str:
        """Return the recording's name, for reports."""
        ...

    @property
    def names(self) -> list[str]:
        """Return the name of each frame: the path of its image relative to the recording."""
        ...

    @property
    def t_ns(self) -> list[int]:
        """Return the time of each frame, in integer nanoseconds."""
        ...

    @property
    def poses(self) -> list[Rigid3 | None]:
        """Return world_from_cam of each frame, None if unknown. No image is read."""
        ...

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> StereoFrame:
        """Read one frame. Raises UnreadableImageError."""
        ...
