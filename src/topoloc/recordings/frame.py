"""One moment of a recording, in one type whatever the format: a stereo pair, or an image with
depth."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, UInt8

from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import StereoRig
from topoloc.geometry.rigid import Rigid3

Image = UInt8[np.ndarray, "h w"] | UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True, eq=False)
class DepthImage:
    """Depth along z in metres, NaN where unknown, as its own camera sees it; registered if
    `cam_from_depth` is the identity."""

    depth: Float32[np.ndarray, "h w"]
    camera: Camera
    cam_from_depth: Rigid3 = field(default_factory=Rigid3.identity)


@dataclass(frozen=True, eq=False)
class StereoFrame:
    """A frame of a recording. `image` is the left (or colour) picture: grey (H, W) or RGB (H, W,
    3), uint8, seen by `camera`.

    Either `right` and `rig` are there (stereo), or `depth` (RGB-D), or neither (a plain picture).
    `world_from_cam` is the truth or an attached trajectory: the pose of the camera of `image`.
    `exif_focal_px` (pixels) is what the picture's file says of a camera that is not known
    otherwise.
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


@runtime_checkable
class StereoSequence(Protocol):
    """A recording, read lazily: nothing but names, times and poses is in memory until a frame is
    asked for."""

    @property
    def name(self) -> str:
        """The recording's name, for reports."""
        ...

    @property
    def names(self) -> list[str]:
        """The name of each frame: the path of its picture relative to the recording."""
        ...

    @property
    def t_ns(self) -> list[int]:
        """The time of each frame, integer nanoseconds."""
        ...

    @property
    def poses(self) -> list[Rigid3 | None]:
        """world_from_cam of each frame, None where unknown; known without reading a picture."""
        ...

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> StereoFrame:
        """Read one frame. Raises UnreadableImageError."""
        ...
