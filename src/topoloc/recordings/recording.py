"""Define the sequence type of all recording formats. Lists are in memory, images stay on disk."""

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

# frame rate of recordings without times
DEFAULT_RATE_HZ = 10
# Numbers have up to 18 digits. Python refuses to parse numbers of thousands of digits.
_SLICE = re.compile(r"(-?\d{1,18})?:(-?\d{1,18})?(?::([1-9]\d{0,17})?)?")
_BLOCK = re.compile(r"(\d{1,18})-(\d{1,18})/([1-9]\d{0,17})")
_INDEX = re.compile(r"-?\d{1,18}")


@dataclass(frozen=True, eq=False)
class RightImages:
    """Hold the right image of each frame, and the rig."""

    paths: list[Path]
    rig: StereoRig


@dataclass(frozen=True, eq=False)
class DepthImages:
    """Hold the depth image of each frame, the scale (file units per metre), and the camera and its
    pose.

    If `camera` is None, depth has the view of the frame's own image, in any resolution.
    """

    paths: list[Path]
    units_per_metre: float
    camera: Camera | None
    cam_from_depth: Rigid3


@dataclass(frozen=True, eq=False)
class Recording:
    """A StereoSequence on disk.

    `names` are image paths relative to `root`. `camera` belongs to the left or colour image.
    `cameras` holds a camera per frame if the frames have different cameras. `has_scale` is False if
    the poses are not in metres, such as those of a model from monocular images.
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

    @staticmethod
    def with_cameras(
        name: str,
        root: Path,
        names: list[str],
        t_ns: list[int],
        poses: list[Rigid3 | None],
        cameras: list[Camera],
        depth: DepthImages | None = None,
        has_scale: bool = True,
    ) -> Recording:
        """Return a recording with a camera for each frame, which may be the same for all."""
        one = cameras[0] if len(set(cameras)) == 1 else None
        return Recording(
            name,
            root,
            names,
            t_ns,
            poses,
            one,
            depth=depth,
            cameras=cameras if one is None else None,
            has_scale=has_scale,
        )

    def __len__(self) -> int:
        return len(self.names)

    def monocular(self) -> Recording:
        """Return the recording without its right and depth images."""
        return replace(self, right=None, depth=None)

    def __getitem__(self, index: int) -> StereoFrame:
        """Read one frame.

        Raises:
            IndexError: there is no such frame.
            UnreadableImageError: an image is missing, damaged, or of another size than its camera.
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
        """Read one frame without its right or depth image. Raises as `__getitem__`."""
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
    """A sequence that may have right or depth images."""

    def monocular(self) -> StereoSequence:
        """Return the recording without right and depth images."""
        ...


@runtime_checkable
class _SupportsLeftFrame(Protocol):
    """A sequence that can read a frame without its right and depth images."""

    def read_left_frame(self, index: int) -> StereoFrame:
        """Read a frame without them."""
        ...


@dataclass(frozen=True, eq=False)
class SequenceView:
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

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, index: int) -> StereoFrame:
        """Read one frame. Raises as the base sequence."""
        return replace(self.base[self.indices[index]], world_from_cam=self.poses[index])


def has_scale(sequence: StereoSequence) -> bool:
    """Return whether the poses are in metres, as far as is known."""
    while isinstance(sequence, SequenceView):
        before = sequence.base.poses
        if any(
            pose is not before[index]
            for index, pose in zip(sequence.indices, sequence.poses, strict=True)
        ):
            return True  # replaced poses are metric
        sequence = sequence.base
    return not isinstance(sequence, Recording) or sequence.has_scale


def scale_poses(sequence: StereoSequence, metres: float) -> StereoSequence:
    """Return the recording with its positions multiplied by `metres`, the metres per unit."""
    poses = [
        None if pose is None else Rigid3(pose.rotation, metres * pose.translation)
        for pose in sequence.poses
    ]
    return SequenceView(sequence, list(range(len(sequence))), poses)


def as_monocular(sequence: StereoSequence) -> StereoSequence:
    """Return the recording without its right and depth images, which are then not read."""
    if isinstance(sequence, SequenceView):
        return replace(sequence, base=as_monocular(sequence.base))
    return sequence.monocular() if isinstance(sequence, _SupportsMonocular) else sequence


def read_left_frame(sequence: StereoSequence, index: int) -> StereoFrame:
    """Read the left (or colour) image of a frame. Right and depth images are not read, if the
    sequence supports that.

    The rig of a stereo pair is kept, because it defines the rectification. Raises as the sequence.
    """
    if type(sequence) is SequenceView:  # a subclass may read frames in another way
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
    """Return notes for the user on a recording that could be opened, such as truncated or guessed
    data."""
    return (
        recording_notes(sequence.base)
        if isinstance(sequence, SequenceView)
        else list(getattr(sequence, "notes", ()))
    )


def sequence_subset(sequence: StereoSequence, indices: Sequence[int]) -> StereoSequence:
    """Return the given frames of a sequence, in this order, with their poses. Images are still read
    one by one.

    Raises:
        IndexError: an index is outside of the sequence.
    """
    poses = sequence.poses
    return SequenceView(sequence, list(indices), [poses[index] for index in indices])


def parse_selection(text: str, num_frames: int) -> list[int]:
    """Return the frame numbers of a selection such as ``0::2``, ``0:10,50:60``, ``-1`` or
    ``0-59/100``.

    The numbers are increasing and unique. A slice is Python's, with a positive step.
    ``FIRST-LAST/PERIOD`` selects the frames whose number modulo PERIOD is in FIRST to LAST, both
    included.

    Raises:
        RecordingError: the text is none of these, or a single number is outside of the recording.
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
    """Return the image files of a folder in natural order (2 before 10). A `suffix` limits them to
    names that end with it.

    Raises:
        RecordingError: the folder is missing or contains no image.
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
    """Return a sort key that compares numbers inside names as numbers of any length."""
    parts = re.split(r"([0-9]+)", name)
    return [
        (len(number := part.lstrip("0")), number) if part.isdigit() else (-1, part)
        for part in parts
    ]


def check_pairs(left: Sequence[Path], right: Sequence[Path]) -> None:
    """Check that two lists of images correspond frame by frame.

    Raises:
        RecordingError: the lengths differ, or the last numbers of two corresponding names differ.
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
    """Return the row of the nearest of `others` (increasing) for each time."""
    after = np.clip(np.searchsorted(others, times), 1, max(len(others) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(others) - 1)
    return [
        int(row) for row in np.where(times - others[before] <= others[after] - times, before, after)
    ]


def times_from_rate(num_frames: int, rate_hz: int = DEFAULT_RATE_HZ) -> list[int]:
    """Return times in nanoseconds at a constant rate, starting at 0."""
    return [index * 1_000_000_000 // rate_hz for index in range(num_frames)]


def _depth_image(depth: DepthImages, index: int, camera: Camera | None) -> DepthImage:
    """Read the depth of a frame whose own image has the camera `camera`."""
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


def find_source_path(sequence: StereoSequence) -> str | None:
    """Return the folder or file of a sequence, or None."""
    while isinstance(sequence, SequenceView):
        sequence = sequence.base
    return str(sequence.root) if isinstance(sequence, Recording) else None


def find_pose_source(sequence: StereoSequence) -> str:
    """Return `truth` if the poses are the recording's own, else `given`."""
    if isinstance(sequence, SequenceView):
        before = sequence.base.poses
        is_same = all(
            pose is before[index]
            for index, pose in zip(sequence.indices, sequence.poses, strict=True)
        )
        return find_pose_source(sequence.base) if is_same else "given"
    return "truth" if isinstance(sequence, Recording) else "given"
