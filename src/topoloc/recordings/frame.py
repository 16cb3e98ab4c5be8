"""Define the frames of a recording, independent of its format: stereo pair, RGB-D or single image.
Use frames in memory as a recording, and find their problems.

A float or 16-bit image, seconds instead of nanoseconds, or millimetres instead of metres would not
cause an error by themselves. Queries would only fail to localize. Swapped red and blue channels
cannot be detected. Features use grey values, which change little with the swap.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Protocol, SupportsIndex, overload, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from topoloc.errors import RecordingError
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
    has its own world and one pose per frame, None outside of the stretch. Depth from `max_depth`
    (metres) on is unknown.
    """

    base: StereoSequence
    indices: list[int]
    poses: list[Rigid3 | None]
    apart: tuple[list[Rigid3 | None], ...] = ()
    max_depth: float = math.inf

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
        frame = replace(self.base[self.indices[row]], world_from_cam=self.poses[row])
        if frame.depth is None or self.max_depth == math.inf:
            return frame
        depth = frame.depth.depth
        known = np.where(depth < np.float32(self.max_depth), depth, np.float32(np.nan))
        return replace(frame, depth=replace(frame.depth, depth=known))


def sequence_subset(
    sequence: StereoSequence, indices: Sequence[int], max_depth: float = math.inf
) -> StereoSequence:
    """Return the given frames of a sequence, in this order, with their poses. Depth from
    `max_depth` (metres) on is unknown. Images are still read one by one. Raises IndexError: an
    index is outside of the sequence."""
    poses, *apart = (sequence.poses, *getattr(sequence, "apart", ()))
    chosen = [[stretch[index] for index in indices] for stretch in (poses, *apart)]
    return SequenceView(sequence, list(indices), chosen[0], tuple(chosen[1:]), max_depth)


MIN_MEDIAN_DEPTH, MAX_MEDIAN_DEPTH = 0.05, 100.0
"""Limits of the median depth of an image, in metres. A median outside of them indicates a wrong
unit."""
# Metres. The most likely unit is the power of ten that brings the median nearest to this.
_TYPICAL_MEDIAN_DEPTH = 2.5
_SAMPLE_STEP = 8  # pixels
_MIN_SPAN_NS = 1_000_000
_EXPECTED_IMAGE = "pictures are uint8, grey (height, width) or RGB (height, width, 3)"


def find_image_problem(image: Any) -> str | None:
    """Describe why an array is not a valid image. Return None if it is valid."""
    if not isinstance(image, np.ndarray):
        return f"a picture is a NumPy array, not {type(image).__name__}; {_EXPECTED_IMAGE}"
    shape = "x".join(map(str, image.shape))
    if image.dtype == np.uint16:
        return f"a picture of 16 bits; {_EXPECTED_IMAGE}: (image >> 8).astype(np.uint8)"
    if image.dtype.kind == "f":
        is_unit = image.size > 0 and float(np.nanmax(image)) <= 1.0
        scaled = "(255 * image).round()" if is_unit else "image.round().clip(0, 255)"
        return f"a picture of type {image.dtype}; {_EXPECTED_IMAGE}: {scaled}.astype(np.uint8)"
    if image.dtype != np.uint8:
        return f"a picture of type {image.dtype}; {_EXPECTED_IMAGE}"
    if 0 in image.shape:
        return f"an empty picture, {shape}"
    if image.ndim == 3 and image.shape[2] == 4:
        return f"a picture with four channels ({shape}); {_EXPECTED_IMAGE}: image[:, :, :3]"
    if image.ndim == 3 and image.shape[0] in (1, 3) and image.shape[2] not in (1, 3):
        return (
            f"a picture with its channels first ({shape}); {_EXPECTED_IMAGE}: image.transpose(1,"
            " 2, 0)"
        )
    if image.ndim == 3 and image.shape[2] == 1:
        return (
            f"a picture of one channel with an axis of its own ({shape}); {_EXPECTED_IMAGE}:"
            " image[:, :, 0]"
        )
    if image.ndim != 2 and (image.ndim != 3 or image.shape[2] != 3):
        return f"an array of shape {shape} is no picture; {_EXPECTED_IMAGE}"
    return None


def find_time_problem(t_ns: Any) -> str | None:
    """Describe why a value is not a time in integer nanoseconds. Return None if it is one."""
    if isinstance(t_ns, bool | np.bool_) or not isinstance(t_ns, int | np.integer):
        return (
            f"t_ns is a time in integer nanoseconds, not {t_ns!r:.40}; of seconds: round(seconds *"
            " 1e9)"
        )
    return None


def find_times_problem(t_ns: Sequence[int]) -> str | None:
    """Describe why the times of a recording are not those of successive frames. Return None if they
    are."""
    for before, after in pairwise(t_ns):
        if after <= before:
            return f"t_ns {after} is not after the one before, {before}"
    if len(t_ns) > 1 and t_ns[-1] - t_ns[0] < _MIN_SPAN_NS:
        return (
            f"{len(t_ns)} frames within {t_ns[-1] - t_ns[0]} ns; t_ns counts nanoseconds, not"
            " seconds, milliseconds or frames"
        )
    return None


def find_frame_problem(frame: StereoFrame) -> str | None:
    """Describe in one line the problem of a frame in memory. Return None if it is consistent."""
    return (
        find_image_problem(frame.image)
        or find_time_problem(frame.t_ns)
        or _find_size_problem("the picture", frame.image, frame.camera)
        or _find_pose_problem(frame.world_from_cam)
        or _find_stereo_problem(frame, frame.right, frame.rig)
        or _find_depth_problem(frame.depth)
    )


def _find_pose_problem(pose: Any) -> str | None:
    if pose is None or isinstance(pose, Rigid3):
        return None
    mend = "of a 4x4 matrix: Rigid3.from_matrix(matrix)"
    return f"world_from_cam is a Rigid3, not {type(pose).__name__}; {mend}"


def _find_stereo_problem(frame: StereoFrame, right: Any, rig: StereoRig | None) -> str | None:
    if right is None and rig is None:
        return None
    if right is None or rig is None:
        return (
            f"a stereo pair needs `right` and `rig`; {'rig' if rig is None else 'right'} is missing"
        )
    if frame.camera != rig.left:
        return "`camera` is that of the left picture, rig.left, and here is another one"
    problem = find_image_problem(right) or _find_size_problem("the right picture", right, rig.right)
    if problem is None and right.shape[:2] != frame.image.shape[:2]:
        problem = "the left and right picture differ in size"
    return problem


def _find_depth_problem(depth: Any) -> str | None:
    if depth is None:
        return None
    if not isinstance(depth, DepthImage):
        return f"depth is a DepthImage(depth, camera), not {type(depth).__name__}"
    array = depth.depth
    if not isinstance(array, np.ndarray) or array.ndim != 2 or array.dtype != np.float32:
        what = type(array).__name__
        if isinstance(array, np.ndarray):
            what = f"{array.dtype} of shape {array.shape}"
        meant = "depth is float32 (height, width) in metres, NaN where unknown"
        return f"{meant}, not {what}; of millimetres: depth.astype(np.float32) / 1000"
    if problem := _find_size_problem("the depth image", array, depth.camera):
        return f"{problem}; coarser depth has the camera of its image, rescaled(width, height)"
    return find_depth_problem(array)


def find_depth_problem(depth: Float32[np.ndarray, "h w"]) -> str | None:
    """Describe the problem if the median depth is implausible, with the likely factor. Return None
    otherwise."""
    sample = depth[::_SAMPLE_STEP, ::_SAMPLE_STEP]
    known = sample[np.isfinite(sample)]
    if len(known) == 0:
        return None
    median = float(np.median(known))
    if MIN_MEDIAN_DEPTH <= median <= MAX_MEDIAN_DEPTH:
        return None
    factor = 10.0 ** round(np.log10(max(median, 1e-30) / _TYPICAL_MEDIAN_DEPTH))
    by = (
        f"{factor:g} times the depth_factor"
        if factor > 1.0
        else f"the depth_factor divided by {1.0 / factor:g}"
    )
    return (
        f"a median depth of {median:.4g} m is that of no camera; {by} is likely right (depth arrays"
        " are in metres)"
    )


def _find_size_problem(what: str, image: np.ndarray, camera: Camera | None) -> str | None:
    if camera is None or image.shape[:2] == (camera.height, camera.width):
        return None
    return f"{what} is {image.shape[1]}x{image.shape[0]}, its camera {camera.width}x{camera.height}"


class MemorySequence(IndexedFrames):
    """A recording of frames in memory: stereo pairs, RGB-D or single images, with or without poses.

    All frames are checked at construction, so that a wrong type, size or unit is reported early.

    Raises:
        RecordingError: there are no frames, or a frame is inconsistent. Names the frame and a
            remedy.
    """

    def __init__(self, frames: Iterable[StereoFrame], name: str = "memory") -> None:
        self.name = name
        self._frames = list(frames)
        if not self._frames:
            raise RecordingError(f"{name}: no frames")
        for number, frame in enumerate(self._frames):
            if not isinstance(frame, StereoFrame):
                raise RecordingError(
                    f"{name}, frame {number}: a StereoFrame is expected, not {type(frame).__name__}"
                )
            problem = find_frame_problem(frame)
            first_size = self._frames[0].image.shape[:2]
            if not problem and frame.camera is None and frame.image.shape[:2] != first_size:
                differs = "its picture is of another size than the first frame's"
                problem = f"{differs}, and neither has a camera"
            if problem is not None:
                raise RecordingError(f"{name}, frame {number} ({frame.name}): {problem}")
        self._frames = [replace(frame, t_ns=int(frame.t_ns)) for frame in self._frames]
        self.names = [frame.name for frame in self._frames]
        self.t_ns = [frame.t_ns for frame in self._frames]
        self.poses = [frame.world_from_cam for frame in self._frames]
        if problem := find_times_problem(self.t_ns):
            raise RecordingError(f"{name}: {problem}")

    def __len__(self) -> int:
        return len(self._frames)

    def read_frame(self, row: int) -> StereoFrame:
        """Return one frame as it was given."""
        return self._frames[row]
