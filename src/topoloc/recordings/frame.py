"""Define the frames of a recording, independent of its format: stereo pair, RGB-D or single
image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, SupportsIndex, overload, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import StereoRig
from topoloc.geometry.rigid import Rigid3
from topoloc.json_data import OneLine

Image = UInt8[np.ndarray, "h w"] | UInt8[np.ndarray, "h w 3"]


def to_grey(image: Image) -> UInt8[np.ndarray, "h w"]:
    """Convert an image to grey with the luma weights of Rec. 601. A grey image is returned
    unchanged."""
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


@dataclass(frozen=True, eq=False, repr=False)
class DepthImage(OneLine):
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
    accessed. `sequence[10]` reads a frame, `sequence[10:50:2]` is the recording of these frames."""

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

    @overload
    def __getitem__(self, index: SupportsIndex, /) -> StereoFrame: ...
    @overload
    def __getitem__(self, index: slice, /) -> StereoSequence: ...


class IndexedFrames:
    """A base class of recordings. It makes indices and slices of `read_frame(row)`, which reads the
    frame of a row counted from 0."""

    def __repr__(self: Any) -> str:
        return f"{type(self).__name__}({self.name!r}, {len(self)} frames)"

    @overload
    def __getitem__(self: Any, index: SupportsIndex, /) -> StereoFrame: ...
    @overload
    def __getitem__(self: Any, index: slice, /) -> StereoSequence: ...
    def __getitem__(self: Any, index: SupportsIndex | slice, /) -> StereoFrame | StereoSequence:
        """Read one frame, or select frames as a recording with their poses. Raises IndexError: no
        such frame; UnreadableImageError: an image is missing, damaged, or not of its camera's size.
        """
        rows = range(len(self))
        if isinstance(index, slice):
            return sequence_subset(self, rows[index])
        if not -len(rows) <= index.__index__() < len(rows):
            raise IndexError(f"{self.name}: no frame {index}; it has {len(rows)}")
        return self.read_frame(rows[index])


@dataclass(frozen=True, eq=False, repr=False)
class SequenceView(IndexedFrames):
    """Show selected frames of another sequence in the given order with the given poses.

    `apart` holds the poses of stretches whose transforms to each other are unknown. Each stretch
    has its own world and one pose per frame, None outside of the stretch.
    """

    base: StereoSequence
    indices: list[int]
    poses: list[Rigid3 | None]
    apart: tuple[list[Rigid3 | None], ...] = ()

    @property
    def name(self) -> str:
        """Return the name of the base sequence."""
        return self.base.name

    @property
    def names(self) -> list[str]:
        """Return the name of each frame."""
        names = self.base.names
        return [names[index] for index in self.indices]

    @property
    def t_ns(self) -> list[int]:
        """Return the time of each frame, in integer nanoseconds."""
        t_ns = self.base.t_ns
        return [t_ns[index] for index in self.indices]

    @property
    def has_own_poses(self) -> bool:
        """Return whether a pose is not that of the base sequence."""
        before = self.base.poses
        pairs = zip(self.indices, self.poses, strict=True)
        return any(pose is not before[index] for index, pose in pairs)

    def __len__(self) -> int:
        return len(self.indices)

    def read_frame(self, row: int) -> StereoFrame:
        """Read one frame. Raises as the base sequence."""
        return replace(self.base[self.indices[row]], world_from_cam=self.poses[row])


def sequence_subset(sequence: StereoSequence, indices: Sequence[int]) -> StereoSequence:
    """Return the given frames of a sequence, in this order, with their poses. Images are still read
    one by one. Raises IndexError: an index is outside of the sequence."""
    poses, *apart = (sequence.poses, *getattr(sequence, "apart", ()))
    chosen = [[stretch[index] for index in indices] for stretch in (poses, *apart)]
    return SequenceView(sequence, list(indices), chosen[0], tuple(chosen[1:]))
