"""Define the sequence type of all recording formats. Lists are in memory, images stay on disk.

Frames whose image files are missing, empty or truncated are left out on request.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from topoloc.errors import RecordingError, UnreadableImageError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import StereoRig
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.exif import exif_focal_length
from topoloc.recordings.frame import (
    DepthImage,
    Image,
    IndexedFrames,
    SequenceView,
    StereoFrame,
    StereoSequence,
    sequence_subset,
)
from topoloc.recordings.image_files import find_path
from topoloc.recordings.image_io import (
    depth_image_of,
    find_white_level,
    read_depth_image,
    read_image,
)


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
class Recording(IndexedFrames):
    """A StereoSequence on disk.

    `names` are image paths relative to `root`. `camera` belongs to the left or colour image.
    `cameras` holds a camera per frame if the frames have different cameras. `has_scale` is False if
    the poses are not in metres, such as those of a model from monocular images. `as_stored` is True
    if the cameras belong to the stored images, not to those turned by their EXIF orientation.
    `notes` are for the user.
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
    as_stored: bool = False
    notes: tuple[str, ...] = ()

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
        as_stored: bool = False,
    ) -> Recording:
        """Return a recording with a camera for each frame, which may be the same for all."""
        others = None, depth, None, has_scale, as_stored
        one = Recording(name, root, names, t_ns, poses, cameras[0], *others)
        return one if len(set(cameras)) == 1 else replace(one, camera=None, cameras=cameras)

    def __repr__(self) -> str:
        others = " of stereo" if self.right else " with depth" if self.depth else ""
        return f"Recording({str(self.root)!r}, {len(self)} frames{others})"

    def __len__(self) -> int:
        return len(self.names)

    def monocular(self) -> Recording:
        """Return the recording without its right and depth images."""
        return replace(self, right=None, depth=None)

    def paths_of(self, index: int) -> list[Path]:
        """Return the image files of a frame."""
        others = [images.paths[index] for images in (self.right, self.depth) if images is not None]
        return [self.root / self.names[index], *others]

    @cached_property
    def _white_level(self) -> int:
        """That of the whole recording, so that dark images stay darker than others."""
        names = self.names[:: max(1, len(self.names) // 5)]
        return find_white_level([self.root / name for name in names])

    def read_frame(self, row: int) -> StereoFrame:
        """Read one frame. Raises as `__getitem__`."""
        frame = self.read_left_frame(row)
        if self.right is not None:
            path, camera = self.right.paths[row], self.right.rig.right
            return replace(frame, right=_read_checked_image(path, camera, self._white_level))
        if self.depth is not None and frame.camera is not None:
            return replace(frame, depth=_depth_image(self.depth, row, frame.camera))
        return frame

    def read_left_frame(self, index: int) -> StereoFrame:
        """Read one frame without its right or depth image. Raises as `__getitem__`."""
        path = self.root / self.names[index]
        camera = self.camera if self.cameras is None else self.cameras[index]
        image = _read_checked_image(path, camera, self._white_level, self.as_stored)
        focal = exif_focal_length(path, image.shape[1], image.shape[0]) if camera is None else None
        name, t_ns, pose = self.names[index], self.t_ns[index], self.poses[index]
        rig = self.right and self.right.rig
        return StereoFrame(name, t_ns, image, camera, None, rig, None, pose, focal)


def with_poses(
    sequence: StereoSequence,
    poses: list[Rigid3 | None],
    apart: tuple[list[Rigid3 | None], ...] = (),
) -> SequenceView:
    """Return a recording with other poses. `apart` is as in `SequenceView`."""
    return SequenceView(sequence, list(range(len(sequence))), poses, apart)


def has_scale(sequence: StereoSequence) -> bool:
    """Return whether the poses are in metres, as far as is known."""
    base, are_own = _base_of(sequence), find_pose_source(sequence) == "truth"
    # replaced poses are metric
    return not (are_own and isinstance(base, Recording)) or base.has_scale


def scale_poses(sequence: StereoSequence, metres: float) -> StereoSequence:
    """Return the recording with its positions multiplied by `metres`, the metres per unit."""
    scaled = (p and Rigid3(p.rotation, metres * p.translation) for p in sequence.poses)
    return with_poses(sequence, list(scaled))


def as_monocular(sequence: StereoSequence) -> StereoSequence:
    """Return the recording without its right and depth images, which are then not read."""
    if isinstance(sequence, SequenceView):
        return replace(sequence, base=as_monocular(sequence.base))
    return getattr(sequence, "monocular", lambda: sequence)()


def read_left_frame(sequence: StereoSequence, index: int) -> StereoFrame:
    """Read the left (or colour) image of a frame. Right and depth images are not read, if the
    sequence supports that.

    The rig of a stereo pair is kept, because it defines the rectification. Raises as the sequence.
    """
    if type(sequence) is SequenceView:  # a subclass may read frames in another way
        frame = read_left_frame(sequence.base, sequence.indices[index])
        return replace(frame, world_from_cam=sequence.poses[index])
    return getattr(sequence, "read_left_frame", sequence.__getitem__)(index)


def keep_frames(sequence: StereoSequence) -> StereoSequence:
    """Return the recording, which then keeps its first frames that are read in memory (256 MB).
    Checks, SLAM and mapping read the same images, and decoding takes a sixth of their time."""
    one = sequence
    while isinstance(one, SequenceView):
        if isinstance(one, _KeepingView):
            return sequence
        one = one.base
    apart = tuple(getattr(sequence, "apart", ()))
    return _KeepingView(sequence, list(range(len(sequence))), list(sequence.poses), apart)


@dataclass(frozen=True, eq=False, repr=False)
class _KeepingView(SequenceView):
    _kept: dict[int, StereoFrame] = field(init=False, default_factory=dict)
    _kept_bytes: list[int] = field(init=False, default_factory=list)

    def read_frame(self, row: int) -> StereoFrame:
        """Read one frame, or return the kept one. Raises as the base sequence."""
        if row in self._kept:
            return self._kept[row]
        frame = super().read_frame(row)
        depth = None if frame.depth is None else frame.depth.depth
        num_bytes = sum(one.nbytes for one in (frame.image, frame.right, depth) if one is not None)
        if self._has_room(num_bytes):
            self._kept[row] = frame
            self._kept_bytes.append(num_bytes)
        return frame

    def read_left_frame(self, index: int) -> StereoFrame:
        """Read one frame without its right or depth image. Raises as `read_frame`."""
        if index in self._kept or self._has_room(max(self._kept_bytes, default=0)):
            return replace(self.read_frame(index), right=None, depth=None)
        frame = read_left_frame(self.base, self.indices[index])
        return replace(frame, world_from_cam=self.poses[index])

    def _has_room(self, num_bytes: int) -> bool:
        return sum(self._kept_bytes) + num_bytes <= 256_000_000


def recording_notes(sequence: StereoSequence) -> list[str]:
    """Return notes for the user on a recording that could be opened, such as truncated or guessed
    data."""
    return list(getattr(_base_of(sequence), "notes", ()))


def _base_of(sequence: StereoSequence) -> StereoSequence:
    """Return the sequence whose frames a view shows."""
    while isinstance(sequence, SequenceView):
        sequence = sequence.base
    return sequence


def _depth_image(depth: DepthImages, index: int, camera: Camera) -> DepthImage:
    """Read the depth of a frame whose own image has the camera `camera`."""
    path = depth.paths[index]
    metres = read_depth_image(path, depth.units_per_metre)
    if depth.camera is not None:
        _check_size(path, metres.shape, depth.camera)
        return DepthImage(metres, depth.camera, depth.cam_from_depth)
    return depth_image_of(path, metres, camera, depth.cam_from_depth)


def _read_checked_image(
    path: Path, camera: Camera | None, white: int, as_stored: bool = False
) -> Image:
    image = read_image(path, as_stored, white)
    if camera is not None:
        if as_stored and image.shape[:2] != (camera.height, camera.width):
            image = read_image(path, white=white)  # a model of turned images
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
    base = _base_of(sequence)
    return str(base.root) if isinstance(base, Recording) else None


def find_depth_units(sequence: StereoSequence) -> float | None:
    """Return the units per metre of the depth images of a recording on disk, or None."""
    base = _base_of(sequence)
    depth = base.depth if isinstance(base, Recording) else None
    return depth and depth.units_per_metre


def find_pose_source(sequence: StereoSequence) -> str:
    """Return `truth` if the poses are the recording's own, else `given`."""
    while isinstance(sequence, SequenceView) and not sequence.has_own_poses:
        sequence = sequence.base
    return "truth" if isinstance(sequence, Recording) else "given"


def leave_out_damaged(
    sequence: StereoSequence, warn: Callable[[str], object] | None = None
) -> StereoSequence:
    """Return a recording of image files without the frames that have a missing, empty or truncated
    file. `warn` is called with their number. Raises RecordingError: more than half have one."""
    base, rows = sequence, list(range(len(sequence)))
    while isinstance(base, SequenceView):
        base, rows = base.base, [base.indices[row] for row in rows]
    paths_of: Callable[[int], list[Path]] | None = getattr(base, "paths_of", None)
    if paths_of is None:
        return sequence
    damaged = [next(filter(None, map(_find_damage, paths_of(row))), None) for row in rows]
    whole = [k for k, damage in enumerate(damaged) if damage is None]
    if len(whole) == len(rows):
        return sequence
    first = next(damage for damage in damaged if damage is not None)
    num = f"{sequence.name}: {len(rows) - len(whole)} of {len(rows)} frames"
    if 2 * len(whole) < len(rows):
        if ": pixels of" in first:
            raise RecordingError(f"{num} have an image that is not read (first: {first})")
        raise RecordingError(
            f"{num} have a missing or damaged image (first: {first}); copy the recording again"
        )
    if warn is not None:
        warn(f"{num} left out: image missing or damaged (first: {first})")
    return sequence_subset(sequence, whole)


def _find_damage(path: Path) -> str | None:
    """Return the path of an image or depth image that is missing, empty or truncated, or the reason
    if its pixels are not read. None if it is whole. PNG and JPEG that end as their format does are
    not decoded. The end of a thumbnail may stand before it."""
    ends = {b"\x89PNG": b"IEND\xaeB`\x82", b"\xff\xd8\xff": b"\xff\xd9"}
    with suppress(OSError), find_path(path).open("rb") as file:
        start = file.read(4)
        file.seek(max(0, file.seek(0, os.SEEK_END) - 8))
        tail = file.read()
        if any(start.startswith(magic) and tail.endswith(end) for magic, end in ends.items()):
            return None
    reason = ""
    for read in (read_image, lambda path: read_depth_image(path, 1.0)):
        try:
            read(path)
        except UnreadableImageError as error:
            reason = reason or str(error)
            continue
        except RecordingError:  # depth of another unit
            pass
        return None
    return reason if ": pixels of" in reason else str(path)
