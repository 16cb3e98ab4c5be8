"""Open ROS bags and MCAP files as recordings. An image is read when its frame is accessed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from topoloc import (
    CalibrationError,
    Camera,
    DepthImage,
    Image,
    RecordingError,
    Rigid3,
    StereoFrame,
    StereoRig,
    UnreadableImageError,
)
from topoloc.apps.core_names import find_white_level
from topoloc.apps.formats.bags.bag import (
    MCAP_SUFFIXES,
    Bag,
    MessageRef,
    Topic,
    is_bag,
    missing_bags_error,
    open_bag_files,
)
from topoloc.apps.formats.bags.bag_calibration import (
    find_depth_camera,
    find_image_size,
    find_left_camera,
    find_rig,
    read_camera_info,
)
from topoloc.apps.formats.bags.bag_clock import Clock
from topoloc.apps.formats.bags.bag_images import (
    are_millimetres,
    decode_depth,
    decode_image,
    image_file,
)
from topoloc.apps.formats.bags.bag_poses import camera_poses, read_transform_tree
from topoloc.apps.formats.bags.messages import decode, frame_id, header_stamp_ns, num_header_bytes
from topoloc.apps.formats.bags.pixel_order import has_reversed_bytes
from topoloc.apps.formats.bags.topics import Roles, is_registered, parse_topics, select_topics
from topoloc.plugin import (
    CameraCalibration,
    EncodedImage,
    IndexedFrames,
    RecordingFormat,
    depth_image_of,
    match_times,
)

MAX_PAIR_DELAY_MS, MAX_DEPTH_DELAY_MS = 5, 20


@dataclass(frozen=True, eq=False)
class ImageMessages:
    """Hold the messages of a topic of images, one for each frame. `is_reversed`: their pixels have
    the other order of bytes than they say. `depth_unit`: that of decoded depth, metres."""

    topic: Topic
    refs: list[MessageRef]
    is_stamped: bool = True
    is_reversed: bool = False
    depth_unit: float = 1.0


@dataclass(frozen=True, eq=False, repr=False)
class BagRecording(IndexedFrames):
    """A StereoSequence of a bag. `names` are the times of the frames in seconds."""

    name: str
    bag: Bag
    t_ns: list[int]
    poses: list[Rigid3 | None]
    camera: Camera | None
    left: ImageMessages
    right: tuple[ImageMessages, StereoRig] | None = None
    depth: tuple[ImageMessages, Camera, Rigid3] | None = None

    names: list[str] = field(init=False)

    def __post_init__(self) -> None:
        names = [f"{t_ns // 1_000_000_000}.{t_ns % 1_000_000_000:09d}" for t_ns in self.t_ns]
        object.__setattr__(self, "names", names)  # the dataclass is frozen

    @property
    def notes(self) -> list[str]:
        """Notes for the user."""
        return self.bag.notes

    @cached_property
    def _white_level(self) -> int:
        """That of the whole recording, so that dark images stay darker than others."""
        return find_white_level(self._sample_files())

    def _sample_files(self) -> Iterator[EncodedImage]:
        for row in range(0, len(self), max(1, len(self) // 5)):
            with suppress(UnreadableImageError):
                message, name = self._read_message(self.left, row)
                if (file := image_file(message, name, self.left.is_reversed)) is None:
                    return
                yield file

    def __len__(self) -> int:
        return len(self.t_ns)

    def monocular(self) -> BagRecording:
        """Return the same recording without its right and depth images."""
        return replace(self, right=None, depth=None)

    def read_frame(self, row: int) -> StereoFrame:
        """Read one frame. Raises UnreadableImageError: a picture is damaged, or of another size
        than its camera."""
        frame = self.read_left_frame(row)
        if self.right is not None:
            right, rig = self.right
            return replace(frame, right=self._read_image(right, row, rig.right))
        if self.depth is not None:
            images, camera, cam_from_depth = self.depth
            message, name = self._read_message(images, row)
            depth = decode_depth(message, name, images.is_reversed) * np.float32(images.depth_unit)
            if camera == self.camera:  # registered, and may be coarser
                return replace(frame, depth=depth_image_of(name, depth, camera, cam_from_depth))
            _check_size(name, depth.shape, camera)
            return replace(frame, depth=DepthImage(depth, camera, cam_from_depth))
        return frame

    def read_left_frame(self, index: int) -> StereoFrame:
        """Read one frame without its right or depth image. Raises the errors of `read_frame`."""
        image = self._read_image(self.left, index, self.camera)
        rig = None if self.right is None else self.right[1]
        name, t_ns, pose = self.names[index], self.t_ns[index], self.poses[index]
        return StereoFrame(name, t_ns, image, self.camera, rig=rig, world_from_cam=pose)

    def _read_image(self, images: ImageMessages, index: int, camera: Camera | None) -> Image:
        message, name = self._read_message(images, index)
        image = decode_image(message, name, lambda: self._white_level, images.is_reversed)
        if camera is not None:
            _check_size(name, image.shape, camera)
        return image

    def _read_message(self, images: ImageMessages, index: int) -> tuple[Any, str]:
        name = f"{self.bag.path}, {images.topic.name} at {self.names[index]}"
        with UnreadableImageError.at(name, RecordingError):
            return decode(images.topic, self.bag.read(images.refs[index])), name


def open_bag(
    path: Path,
    topics: str | Mapping[str, str] | None = None,
    calibration: Callable[[int, int], CameraCalibration] | None = None,
) -> BagRecording:
    """Open a bag. Topics that are not given are guessed. No image is read. Raises RecordingError:
    no bag, a topic that is not in it, no pictures, or none with its right picture or depth;
    CalibrationError: the calibration of a pair or of depth is missing or not usable;
    TrajectoryError: the requested poses fit no frame; MissingExtraError: the extra `bags`
    is not installed.

    Args:
        topics: the topic of a role (``left``, ``right``, ``depth``, ``left_info``, ``right_info``,
            ``depth_info``, ``pose``), and ``pose_frame``, the frame that the poses are of; as a
            dictionary or ``left=/cam0/image_raw,pose=/odom``. ``pose`` may be ``tf`` or ``none``.
        calibration: replaces that of the left camera and of registered depth, or of a pair. A
            rectified pair keeps its baseline.
    """
    bag = open_bag_files(path)
    try:
        requested = parse_topics(topics) if isinstance(topics, str) else dict(topics or {})
        roles = select_topics(bag, requested)
        given = calibration and calibration(*find_image_size(bag, roles.left))
        recording = _open_recording(bag, roles, given)
    except ModuleNotFoundError as error:
        raise missing_bags_error(error, path) from error
    bag.add_fault_notes()
    return recording


def _open_recording(bag: Bag, roles: Roles, given: CameraCalibration | None) -> BagRecording:
    t_ns, left = _index_by_time(bag, roles.left, is_first=True)
    tree, info = read_transform_tree(bag), read_camera_info(bag, roles.left_info, roles.left)
    frame = (info.frame if info is not None else "") or _read_frame_id(bag, left)
    camera = find_left_camera(bag, roles, info, given)
    right, depth = None, None
    if roles.right is not None:
        rig = find_rig(bag, roles, info, tree, given)
        t_ns, left, images = _match_by_time(bag, (t_ns, left), roles.right, MAX_PAIR_DELAY_MS)
        camera, right = rig.left, (images, rig)
    elif roles.depth is not None:
        if camera is None:
            raise CalibrationError(
                f"{bag.path}: no calibration of {roles.left}; use --camera FILE, --topics"
                " left_info=TOPIC, or a camera.json beside the bag"
            )
        t_ns, left, images = _match_by_time(bag, (t_ns, left), roles.depth, MAX_DEPTH_DELAY_MS)
        is_replaced = given is not None and is_registered(roles.depth)
        depth_info = None if is_replaced else roles.depth_info
        images = replace(images, depth_unit=_find_depth_unit(bag, images))
        depth = (images, *find_depth_camera(bag, roles.depth, depth_info, camera, frame, tree))
    poses = camera_poses(bag, roles, frame, tree, t_ns)
    return BagRecording(bag.path.resolve().name, bag, t_ns, poses, camera, left, right, depth)


def _index_by_time(bag: Bag, name: str, is_first: bool = False) -> tuple[list[int], ImageMessages]:
    """Return the messages of a topic sorted by their own times. Damaged ones are skipped with a
    note. The first topic tells whether the clock was set back."""
    topic = bag.topics[name]
    stamped, num_damaged = bag.parse_messages(name, header_stamp_ns, num_header_bytes(topic))
    bag.note_damaged(num_damaged, name)
    if not stamped:
        raise RecordingError(f"{bag.path}: no whole message of {name}")
    if is_first:
        known = [(ref.place, t_ns, ref.log_t_ns) for ref, t_ns in stamped if t_ns is not None]
        bag.clock = Clock.of_times(known)
        if bag.clock.starts:
            bag.notes.append(f"{bag.path}: {bag.clock.describe(name)}")
    times = [None if t is None else bag.clock.unwrap(ref.place, t) for ref, t in stamped]
    # a driver that sets no times writes 0, or one time, into each
    is_stamped = sum(not time for time in times) <= 1 and 2 * len(set(times)) >= len(times)
    if not is_stamped:
        bag.notes.append(
            f"{bag.path}: the header times of {name} are 0 or the same: the times of writing are"
            " used"
        )
    timed = [
        (ref, time if is_stamped and time is not None else ref.log_t_ns)
        for (ref, _), time in zip(stamped, times, strict=True)
    ]
    by_time = {time: ref for ref, time in timed}
    _note_same_times(bag, name, [(ref, by_time[t]) for ref, t in timed if by_time[t] != ref])
    t_ns = sorted(by_time)
    refs = [by_time[time] for time in t_ns]
    is_reversed = has_reversed_bytes(bag, topic, refs)
    return t_ns, ImageMessages(topic, refs, is_stamped, is_reversed)


def _note_same_times(bag: Bag, name: str, pairs: list[tuple[MessageRef, MessageRef]]) -> None:
    """Note the number of messages that are left out because another one has their time. A message
    that was recorded twice is none of them."""
    for ref, other in pairs[:5]:
        with suppress(RecordingError):
            if bag.read(ref) != bag.read(other):
                bag.notes.append(
                    f"{bag.path}: {len(pairs)} pictures of {name} have the time of another one and"
                    " are left out"
                )
                return


def _match_by_time(
    bag: Bag, first: tuple[list[int], ImageMessages], name: str, delay_ms: int
) -> tuple[list[int], ImageMessages, ImageMessages]:
    """Return the times and images that have a partner on the topic `name` within `delay_ms`, and
    the partners. If one topic has no header times, the times of writing are compared."""
    t_ns, left = first
    others, images = _index_by_time(bag, name)
    times = t_ns
    if not (left.is_stamped and images.is_stamped):
        images = replace(images, refs=sorted(images.refs))
        times, others = ([ref.log_t_ns for ref in its.refs] for its in (left, images))
        delay_ms = max(delay_ms, _quarter_period_ms(others))  # they are written when they arrive
    pairs, notes = match_times(times, others, delay_ms, str(bag.path), (left.topic.name, name))
    bag.notes += notes
    matched = replace(left, refs=[left.refs[row] for row, _ in pairs])
    partners = replace(images, refs=[images.refs[row] for _, row in pairs])
    return [t_ns[row] for row, _ in pairs], matched, partners


def _find_depth_unit(bag: Bag, images: ImageMessages) -> float:
    """Return the unit of decoded depth in metres. A note tells of float depth in millimetres."""
    samples = [np.zeros(0, np.float32)]
    for ref in images.refs[:: -(-len(images.refs) // 5)]:
        with suppress(RecordingError):
            message = decode(images.topic, bag.read(ref))
            if "32FC1" in getattr(message, "encoding", getattr(message, "format", "")):
                depth = decode_depth(message, images.topic.name, images.is_reversed)
                samples.append(depth[np.isfinite(depth)])
    if not are_millimetres(np.concatenate(samples)):
        return 1.0
    bag.notes.append(
        f"{bag.path}: depth of {images.topic.name} is read in millimetres: as metres, which 32FC1"
        " should be, it would be that of no camera"
    )
    return 1e-3


def _quarter_period_ms(t_ns: list[int]) -> int:
    steps = sorted(after - before for before, after in pairwise(t_ns))
    return steps[len(steps) // 2] // 4_000_000 if steps else 0


def _read_frame_id(bag: Bag, images: ImageMessages) -> str:
    try:
        return frame_id(decode(images.topic, bag.read(images.refs[0])))
    except (RecordingError, AttributeError):
        return ""


def _check_size(name: str, shape: tuple[int, ...], camera: Camera) -> None:
    if shape[:2] != (camera.height, camera.width):
        raise UnreadableImageError(
            f"{name}: {shape[1]}x{shape[0]} pixels, but its camera is of"
            f" {camera.width}x{camera.height}"
        )


EXPECTED_FILES = "a ROS bag: .bag, .db3, or a folder with metadata.yaml"
_OPTIONS = ("topics", "calibration")
ROSBAG_FORMAT = RecordingFormat(EXPECTED_FILES, is_bag, open_bag, _OPTIONS)
MCAP_FORMAT = RecordingFormat(
    "an .mcap file", lambda path: is_bag(path, MCAP_SUFFIXES), open_bag, _OPTIONS
)
