"""Open ROS bags and MCAP files as recordings. An image is read when its frame is accessed."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
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
from topoloc.apps.formats.bags.bag import (
    MCAP_SUFFIXES,
    Bag,
    MessageRef,
    Topic,
    is_bag,
    missing_bags_error,
    open_bag_files,
)
from topoloc.apps.formats.bags.bag_images import CameraInfo, camera_info, decode_depth, decode_image
from topoloc.apps.formats.bags.bag_poses import TransformTree, camera_poses, read_transform_tree
from topoloc.apps.formats.bags.messages import decode, frame_id, header_stamp_ns, num_header_bytes
from topoloc.apps.formats.bags.topics import (
    Roles,
    is_rectified,
    is_registered,
    parse_topics,
    select_topics,
)
from topoloc.plugin import RecordingFormat, find_nearest_idx, read_camera_json

MAX_PAIR_DELAY_MS, MAX_DEPTH_DELAY_MS = 5, 20


@dataclass(frozen=True, eq=False)
class ImageMessages:
    """Hold the messages of a topic of images, one for each frame."""

    topic: Topic
    refs: list[MessageRef]


@dataclass(frozen=True, eq=False)
class BagRecording:
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

    def __len__(self) -> int:
        return len(self.t_ns)

    def monocular(self) -> BagRecording:
        """Return the same recording without its right and depth images."""
        return replace(self, right=None, depth=None)

    def __getitem__(self, index: int) -> StereoFrame:
        """Read one frame. Raises IndexError: no such frame; UnreadableImageError: a picture is
        damaged, or of another size than its camera."""
        frame = self.read_left_frame(index)
        if self.right is not None:
            right, rig = self.right
            return replace(frame, right=self._read_image(right, index, rig.right))
        if self.depth is not None:
            images, camera, cam_from_depth = self.depth
            message, name = self._read_message(images, index)
            depth = decode_depth(message, name)
            _check_size(name, depth.shape, camera)
            return replace(frame, depth=DepthImage(depth, camera, cam_from_depth))
        return frame

    def read_left_frame(self, index: int) -> StereoFrame:
        """Read one frame without its right or depth image. Raises the errors of `__getitem__`."""
        image = self._read_image(self.left, index, self.camera)
        rig = None if self.right is None else self.right[1]
        name, t_ns, pose = self.names[index], self.t_ns[index], self.poses[index]
        return StereoFrame(name, t_ns, image, self.camera, rig=rig, world_from_cam=pose)

    def _read_image(self, images: ImageMessages, index: int, camera: Camera | None) -> Image:
        message, name = self._read_message(images, index)
        image = decode_image(message, name)
        if camera is not None:
            _check_size(name, image.shape, camera)
        return image

    def _read_message(self, images: ImageMessages, index: int) -> tuple[Any, str]:
        name = f"{self.bag.path}, {images.topic.name} at {self.names[index]}"
        try:
            return decode(images.topic, self.bag.read(images.refs[index])), name
        except RecordingError as error:
            raise UnreadableImageError(f"{name}: {error}") from None


def open_bag(path: Path, topics: str | Mapping[str, str] | None = None) -> BagRecording:
    """Open a bag. Topics that are not given are guessed. No image is read. Raises RecordingError:
    no bag, a topic that is not in it, no pictures, or none with its right picture or depth;
    CalibrationError: the calibration of a pair or of depth is missing or not usable;
    TrajectoryError: the requested poses fit no frame; MissingExtraError: the extra `bags`
    is not installed.

    Args:
        topics: the topic of a role (``left``, ``right``, ``depth``, ``left_info``, ``right_info``,
            ``depth_info``, ``pose``), and ``pose_frame``, the frame that the poses are of; as a
            dictionary or ``left=/cam0/image_raw,pose=/odom``. ``pose`` may be ``tf`` or ``none``.
    """
    bag = open_bag_files(path)
    try:
        requested = parse_topics(topics) if isinstance(topics, str) else dict(topics or {})
        roles = select_topics(bag, requested)
        recording = _open_recording(bag, roles)
    except ModuleNotFoundError as error:
        raise missing_bags_error(error, path) from error
    bag.add_fault_notes()
    return recording


def _open_recording(bag: Bag, roles: Roles) -> BagRecording:
    t_ns, left = _index_by_time(bag, roles.left)
    tree, info = read_transform_tree(bag), _read_camera_info(bag, roles.left_info)
    frame = (info.frame if info is not None else "") or _read_frame_id(bag, left)
    camera = (
        info.camera(is_rectified(roles.left)) if info is not None else _read_folder_camera(bag)[0]
    )
    right, depth = None, None
    if roles.right is not None:
        rig = _rig(bag, roles, info, tree)
        t_ns, left, images = _match_by_time(bag, (t_ns, left), roles.right, MAX_PAIR_DELAY_MS)
        camera, right = rig.left, (images, rig)
    elif roles.depth is not None:
        if camera is None:
            raise CalibrationError(
                f"{bag.path}: no calibration of {roles.left}; --topics left_info=TOPIC, or a"
                " camera.json beside the bag"
            )
        t_ns, left, images = _match_by_time(bag, (t_ns, left), roles.depth, MAX_DEPTH_DELAY_MS)
        depth = (images, *_depth_camera(bag, roles, camera, frame, tree))
    poses = camera_poses(bag, roles, frame, tree, t_ns)
    return BagRecording(bag.path.resolve().name, bag, t_ns, poses, camera, left, right, depth)


def _index_by_time(bag: Bag, name: str) -> tuple[list[int], ImageMessages]:
    """Return the messages of a topic sorted by their own times. Damaged ones are skipped with a
    note."""
    topic = bag.topics[name]
    stamped, num_damaged = bag.parse_messages(name, header_stamp_ns, num_header_bytes(topic))
    bag.note_damaged(num_damaged, name)
    # a driver that sets no times writes 0 into each
    is_stamped = sum(not stamp for _, stamp in stamped) <= 1
    by_time = {
        stamp if is_stamped and stamp is not None else ref.log_t_ns: ref for ref, stamp in stamped
    }
    if not by_time:
        raise RecordingError(f"{bag.path}: no whole message of {name}")
    t_ns = sorted(by_time)
    return t_ns, ImageMessages(topic, [by_time[time] for time in t_ns])


def _match_by_time(
    bag: Bag, first: tuple[list[int], ImageMessages], name: str, delay_ms: int
) -> tuple[list[int], ImageMessages, ImageMessages]:
    """Return the times and images that have a partner on the topic `name` within `delay_ms`, and
    the partners."""
    t_ns, left = first
    others, images = _index_by_time(bag, name)
    nearest = find_nearest_idx(np.array(t_ns), np.array(others))
    delays = [abs(time - others[other]) for time, other in zip(t_ns, nearest, strict=True)]
    kept = [row for row, delay in enumerate(delays) if delay <= delay_ms * 1_000_000]
    lacking = (
        f"of {len(t_ns)} pictures of {left.topic.name} have none of {name} ({len(others)}) within"
        f" {delay_ms} ms"
    )
    if not kept:
        off = min(delays) / 1e6
        raise RecordingError(f"{bag.path}: {len(t_ns)} {lacking}; the nearest is {off:.1f} ms away")
    if len(kept) < len(t_ns):
        bag.notes.append(f"{bag.path}: {len(t_ns) - len(kept)} {lacking} and are left out")
    refs, partners = [left.refs[row] for row in kept], [images.refs[nearest[row]] for row in kept]
    matched = ImageMessages(left.topic, refs), ImageMessages(images.topic, partners)
    return [t_ns[row] for row in kept], *matched


def _read_camera_info(bag: Bag, name: str | None) -> CameraInfo | None:
    """Return the first complete calibration of a topic."""
    if name is None:
        return None
    for ref in bag.messages(name)[:10]:
        with suppress(RecordingError):
            message = decode(bag.topics[name], bag.read(ref))
            break
    else:
        raise CalibrationError(f"{bag.path}: no whole message of {name}")
    return camera_info(message, name)


def _read_frame_id(bag: Bag, images: ImageMessages) -> str:
    try:
        return frame_id(decode(images.topic, bag.read(images.refs[0])))
    except (RecordingError, AttributeError):
        return ""


def _rig(bag: Bag, roles: Roles, left: CameraInfo | None, tree: TransformTree) -> StereoRig:
    """Return the rig: from P of both calibrations, else from the transform between their frames,
    else from a camera.json with a baseline."""
    right = _read_camera_info(bag, roles.right_info)
    if left is not None and right is not None:
        rig = left.rig(right, is_rectified(roles.left))
        if rig is not None:
            return rig
        right_from_left = None
        if left.frame != right.frame:
            right_from_left = tree.find_static_transform(right.frame, left.frame)
        if right_from_left is not None and is_rectified(roles.left):
            baseline = float(np.linalg.norm(right_from_left.translation))
            return StereoRig.rectified(left.camera(True), baseline)
        if right_from_left is not None:
            return StereoRig(left.camera(False), right.camera(False), right_from_left)
    camera, baseline = _read_folder_camera(bag)
    if camera is not None and baseline is not None:
        return StereoRig.rectified(camera, baseline)
    infos = {"left": left, "right": right}
    lacking = " and ".join(side for side, info in infos.items() if info is None)
    what = f"neither P of {roles.right_info} nor TF says where the right camera is"
    what = f"no calibration of the {lacking} camera" if lacking else what
    raise CalibrationError(
        f"{bag.path}: {what}; --topics left_info=TOPIC,right_info=TOPIC, or a camera.json with a"
        " baseline beside the bag"
    )


def _depth_camera(
    bag: Bag, roles: Roles, camera: Camera, frame: str, tree: TransformTree
) -> tuple[Camera, Rigid3]:
    """Return the camera of the depth images, and cam_from_depth. Registered ones have the colour
    camera."""
    info = _read_camera_info(bag, roles.depth_info)
    if info is None:
        return camera, Rigid3.identity()
    cam_from_depth = tree.find_static_transform(frame, info.frame) if frame and info.frame else None
    if cam_from_depth is None:
        cam_from_depth = Rigid3.identity()
        if not is_registered(roles.depth or ""):
            bag.notes.append(
                f"{bag.path}: no fixed transform from that of {roles.depth} to the camera of the"
                " pictures: taken for the same place"
            )
    return info.camera(is_rectified(roles.depth or "")), cam_from_depth


def _read_folder_camera(bag: Bag) -> tuple[Camera | None, float | None]:
    path = (bag.path if bag.path.is_dir() else bag.path.parent) / "camera.json"
    if not path.is_file():
        return None, None
    file = read_camera_json(path)
    return file.camera, None if file.rig is None else file.rig.baseline


def _check_size(name: str, shape: tuple[int, ...], camera: Camera) -> None:
    if shape[:2] != (camera.height, camera.width):
        raise UnreadableImageError(
            f"{name}: {shape[1]}x{shape[0]} pixels, but its camera is of"
            f" {camera.width}x{camera.height}"
        )


EXPECTED_FILES = "a ROS bag: .bag, .db3, or a folder with metadata.yaml"
ROSBAG_FORMAT = RecordingFormat(EXPECTED_FILES, is_bag, open_bag, ("topics",))
MCAP_FORMAT = RecordingFormat(
    "an .mcap file", lambda path: is_bag(path, MCAP_SUFFIXES), open_bag, ("topics",)
)
