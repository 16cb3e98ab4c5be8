"""The one sequence type behind every format: lists in memory, pictures on disk until they are asked
for."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from topoloc.errors import RecordingError, UnreadableImageError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import StereoRig
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.depth_images import read_depth_image, resize_depth
from topoloc.recordings.frame import DepthImage, Image, StereoFrame, StereoSequence
from topoloc.recordings.image_io import IMAGE_SUFFIXES, exif_focal_length, read_image

# Recordings without times are taken to be of this rate.
DEFAULT_RATE_HZ = 10
# Numbers of up to 18 digits: longer ones name no frame, and Python refuses to read those of
# thousands.
_SLICE = re.compile(r"(-?\d{1,18})?:(-?\d{1,18})?(?::([1-9]\d{0,17})?)?")
_BLOCK = re.compile(r"(\d{1,18})-(\d{1,18})/([1-9]\d{0,17})")
_INDEX = re.compile(r"-?\d{1,18}")


@dataclass(frozen=True, eq=False)
class RightImages:
    """The right picture of each frame, and the rig."""

    paths: list[Path]
    rig: StereoRig


@dataclass(frozen=True, eq=False)
class DepthImages:
    """The depth picture of each frame: its scale (file units a metre), its camera, and where that
    camera sits.

    Without a camera it shows what the frame's own picture shows, in pixels of any size.
    """

    paths: list[Path]
    units_per_metre: float
    camera: Camera | None
    cam_from_depth: Rigid3


@dataclass(frozen=True, eq=False)
class Recording:
    """A StereoSequence on disk. `names` are picture paths relative to `root`; `camera` is that of
    the left or colour picture.

    `cameras` are those of the frames one by one, where they are not of one camera. Poses of a model
    of pictures alone are in no metres (`has_scale`).
    """

    name: str
    root: Path
    names: list[str]
    t_ns: list[int]
    poses: list[Rigid3 | None]
    camera: Camera | None
    right: RightImages | None = None
    depth: DepthImages | None = None
    cameras: list[Camera] | None = None
    has_scale: bool = True

    def __len__(self) -> int:
        return len(self.names)

    def monocular(self) -> Recording:
        """The same recording without its right and depth pictures."""
        return replace(self, right=None, depth=None)

    def __getitem__(self, index: int) -> StereoFrame:
        """Read one frame.

        Raises:
            IndexError: no such frame.
            UnreadableImageError: a picture is missing, broken, or of another size than its camera.
        """
        frame = self.read_left_frame(index)
        if self.right is not None:
            return replace(
                frame, right=_read_checked_image(self.right.paths[index], self.right.rig.right)
            )
        if self.depth is not None:
            return replace(frame, depth=_depth_image(self.depth, index, frame.camera))
        return frame

    def read_left_frame(self, index: int) -> StereoFrame:
        """Read one frame but for its right or depth picture. Raises as the whole frame does."""
        path = self.root / self.names[index]
        camera, rig = (
            self.camera if self.cameras is None else self.cameras[index],
            None if self.right is None else self.right.rig,
        )
        image = _read_checked_image(path, camera)
        focal = exif_focal_length(path, image.shape[1], image.shape[0]) if camera is None else None
        return StereoFrame(
            self.names[index],
            self.t_ns[index],
            image,
            camera,
            rig=rig,
            world_from_cam=self.poses[index],
            exif_focal_px=focal,
        )


@runtime_checkable
class _SupportsMonocular(Protocol):
    """A sequence that may have right or depth pictures."""

    def monocular(self) -> StereoSequence:
        """The same recording without them."""
        ...


@runtime_checkable
class _SupportsLeftFrame(Protocol):
    """A sequence whose right and depth pictures are files of their own."""

    def read_left_frame(self, index: int) -> StereoFrame:
        """A frame without them, which are not read."""
        ...


@dataclass(frozen=True, eq=False)
class SequenceView:
    """Some frames of another sequence, in this order, with these poses.

    `apart` are poses of stretches of which nobody knows how they lie to the others: each in a world
    of its own, a pose a frame, None outside of the stretch.
    """

    base: StereoSequence
    indices: list[int]
    poses: list[Rigid3 | None]
    apart: tuple[list[Rigid3 | None], ...] = ()

    @property
    def name(self) -> str:
        return self.base.name

    @property
    def names(self) -> list[str]:
        names = self.base.names
        return [names[index] for index in self.indices]

    @property
    def t_ns(self) -> list[int]:
        t_ns = self.base.t_ns
        return [t_ns[index] for index in self.indices]

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, index: int) -> StereoFrame:
        """Read one frame. Raises as the sequence below does."""
        return replace(self.base[self.indices[index]], world_from_cam=self.poses[index])


def has_scale(sequence: StereoSequence) -> bool:
    """Whether the poses are in metres, as far as is known."""
    while isinstance(sequence, SequenceView):
        before = sequence.base.poses
        if any(
            pose is not before[index]
            for index, pose in zip(sequence.indices, sequence.poses, strict=True)
        ):
            return True  # poses from elsewhere
        sequence = sequence.base
    return not isinstance(sequence, Recording) or sequence.has_scale


def scale_poses(sequence: StereoSequence, metres: float) -> StereoSequence:
    """The same recording with poses of which a unit is so many metres."""
    poses = [
        None if pose is None else Rigid3(pose.rotation, metres * pose.translation)
        for pose in sequence.poses
    ]
    return SequenceView(sequence, list(range(len(sequence))), poses)


def as_monocular(sequence: StereoSequence) -> StereoSequence:
    """The same recording without its right and depth pictures, which are then not read either."""
    if isinstance(sequence, SequenceView):
        return replace(sequence, base=as_monocular(sequence.base))
    return sequence.monocular() if isinstance(sequence, _SupportsMonocular) else sequence


def read_left_frame(sequence: StereoSequence, index: int) -> StereoFrame:
    """A frame of which only the left (or colour) picture is asked: right and depth pictures are not
    read, where that is possible. A pair's rig is there, for it says how the left picture is
    rectified. Raises as the sequence does."""
    if type(sequence) is SequenceView:  # one that reads otherwise is asked itself
        return replace(
            read_left_frame(sequence.base, sequence.indices[index]),
            world_from_cam=sequence.poses[index],
        )
    return (
        sequence.read_left_frame(index)
        if isinstance(sequence, _SupportsLeftFrame)
        else sequence[index]
    )


def recording_notes(sequence: StereoSequence) -> list[str]:
    """What a user should know of a recording that could be opened all the same: what was cut off,
    what was guessed."""
    return (
        recording_notes(sequence.base)
        if isinstance(sequence, SequenceView)
        else list(getattr(sequence, "notes", ()))
    )


def sequence_subset(sequence: StereoSequence, indices: Sequence[int]) -> StereoSequence:
    """These frames of a sequence, in this order, with their poses; pictures are still read one by
    one.

    Raises:
        IndexError: an index lies outside the sequence.
    """
    poses = sequence.poses
    return SequenceView(sequence, list(indices), [poses[index] for index in indices])


def parse_selection(text: str, num_frames: int) -> list[int]:
    """Frame numbers, increasing and once each, of a selection such as ``0::2``, ``0:10,50:60``,
    ``-1`` or ``0-59/100``.

    A slice is Python's, with a positive step; ``FIRST-LAST/PERIOD`` are the frames whose number
    modulo PERIOD lies in FIRST to LAST, both included.

    Raises:
        RecordingError: it is none of these, or a single number lies outside the recording.
    """
    chosen: set[int] = set()
    for part in text.split(","):
        part = part.strip()
        if bounds := _SLICE.fullmatch(part):
            chosen.update(
                range(num_frames)[
                    slice(*(int(bound) if bound else None for bound in bounds.groups()))
                ]
            )
        elif block := _BLOCK.fullmatch(part):
            first, last, period = (int(number) for number in block.groups())
            chosen.update(index for index in range(num_frames) if first <= index % period <= last)
        elif _INDEX.fullmatch(part):
            if not -num_frames <= int(part) < num_frames:
                raise RecordingError(f"frame {part} of a recording of {num_frames}")
            chosen.add(int(part) % num_frames)
        else:
            raise RecordingError(
                f"{part!r} chooses no frames; write START:STOP:STEP, a number, or FIRST-LAST/PERIOD"
            )
    return sorted(chosen)


def list_images(folder: Path, suffix: str = "") -> list[Path]:
    """The picture files of a folder in natural order (2 before 10), those only whose name ends in
    `suffix` if given.

    Raises:
        RecordingError: the folder is missing or holds no picture.
    """
    try:
        paths = [
            path
            for path in folder.iterdir()
            if path.suffix.lower() in IMAGE_SUFFIXES and path.stem.endswith(suffix)
        ]
    except OSError as error:
        raise RecordingError(f"{folder}: {error.strerror}") from None
    paths = [path for path in paths if not path.name.startswith(".")]
    if not paths:
        raise RecordingError(f"{folder}: no pictures in this folder")
    return sorted(paths, key=lambda path: natural_key(path.name))


def natural_key(name: str) -> list[tuple[int, str]]:
    """A sort key by which numbers inside names compare as numbers, however many digits they
    have."""
    parts = re.split(r"([0-9]+)", name)
    return [
        (len(number := part.lstrip("0")), number) if part.isdigit() else (-1, part)
        for part in parts
    ]


def check_pairs(left: Sequence[Path], right: Sequence[Path]) -> None:
    """Hold that two lists of pictures go together, frame by frame.

    Raises:
        RecordingError: of unequal lengths, or the numbers in two names that would go together
            differ.
    """
    if len(left) != len(right):
        raise RecordingError(
            f"{left[0].parent}: {len(left)} pictures here but {len(right)} in"
            f" {right[0].parent.name}; every picture needs its partner"
        )
    for path, other in zip(left, right, strict=True):
        if re.findall(r"\d+", path.stem)[-1:] != re.findall(r"\d+", other.stem)[-1:]:
            raise RecordingError(
                f"{path}: its partner in {other.parent.name} is missing (the next there is"
                f" {other.name})"
            )


def find_nearest_idx(times: np.ndarray, others: np.ndarray) -> list[int]:
    """The row of the nearest of `others` (increasing) for each time."""
    after = np.clip(np.searchsorted(others, times), 1, max(len(others) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(others) - 1)
    return [
        int(row) for row in np.where(times - others[before] <= others[after] - times, before, after)
    ]


def times_from_rate(num_frames: int, rate_hz: int = DEFAULT_RATE_HZ) -> list[int]:
    """Times in nanoseconds of frames at a steady rate from 0."""
    return [index * 1_000_000_000 // rate_hz for index in range(num_frames)]


def _depth_image(depth: DepthImages, index: int, camera: Camera | None) -> DepthImage:
    """The depth of a frame whose own picture is seen by `camera`."""
    path = depth.paths[index]
    metres = read_depth_image(path, depth.units_per_metre)
    if depth.camera is not None:
        _check_size(path, metres.shape, depth.camera)
        return DepthImage(metres, depth.camera, depth.cam_from_depth)
    assert camera is not None, "depth that is the picture's own is of a picture with a camera"
    return DepthImage(resize_depth(path, metres, camera), camera, depth.cam_from_depth)


def _read_checked_image(path: Path, camera: Camera | None) -> Image:
    image = read_image(path)
    if camera is not None:
        _check_size(path, image.shape, camera)
    return image


def _check_size(path: Path, shape: tuple[int, ...], camera: Camera) -> None:
    if shape[:2] != (camera.height, camera.width):
        raise UnreadableImageError(
            f"{path}: {shape[1]}x{shape[0]} pixels, but its camera is of"
            f" {camera.width}x{camera.height}"
        )
