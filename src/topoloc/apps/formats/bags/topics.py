"""Select the topics of a bag: given by ``--topics``, or guessed from types and the usual names of
drivers."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

from topoloc import RecordingError
from topoloc.apps.core_names import suggest_name
from topoloc.apps.formats.bags.bag import Bag
from topoloc.apps.formats.bags.messages import (
    CALIBRATION_TYPES,
    COMPRESSED_IMAGE_TYPES,
    IMAGE_TYPES,
    POSE_TYPES,
    TRANSFORM_TYPES,
)

ROLES = ("left", "right", "depth", "left_info", "right_info", "depth_info", "pose", "pose_frame")
_ROLE_ALIASES: dict[str, str] = dict.fromkeys(("image", "mono", "color"), "left")
_ROLE_ALIASES |= dict.fromkeys(("camera_info", "info"), "left_info")
_NONE, TF = "none", "tf"
# Parts of the names of left and right topics.
_LEFT_RIGHT_NAMES = (
    ("left", "right"),
    ("infra1", "infra2"),
    ("cam0", "cam1"),
    ("camera0", "camera1"),
    ("cam_0", "cam_1"),
    ("image_0", "image_1"),
    ("Infrared_1", "Infrared_2"),
)
_DEPTH_WORDS = ("depth",)
_NON_IMAGE_WORDS = ("disparity", "confidence", "mask", "segmentation", "thermal")
_REGISTERED_WORDS = ("aligned", "registered")
_COLOUR_WORDS = ("color", "colour", "rgb")
_TRUTH_WORDS = ("truth", "gt", "mocap", "vicon", "optitrack")
_TRANSPORT_SUFFIXES = ("/compressedDepth", "/compressed")


@dataclass(frozen=True)
class Roles:
    """Hold the topic of each role. `poses` are tried in order and may be `tf`. `pose_frame` is the
    frame of the poses."""

    left: str = ""
    right: str | None = None
    depth: str | None = None
    left_info: str | None = None
    right_info: str | None = None
    depth_info: str | None = None
    poses: tuple[str, ...] = ()
    pose_frame: str | None = None
    is_pose_requested: bool = False


def parse_topics(text: str) -> dict[str, str]:
    """Parse ``left=/cam0/image_raw,pose=/odom`` to a dictionary. Raises RecordingError: not of this
    form, or a role that there is not."""
    requested: dict[str, str] = {}
    for part in text.split(","):
        role, is_one, topic = (piece.strip() for piece in part.partition("="))
        role = _ROLE_ALIASES.get(role, role)
        if not is_one or not topic:
            raise RecordingError(
                f"topics {part.strip()[:80]!r}: ROLE=TOPIC is expected, as in left=/cam0/image_raw"
            )
        if role not in ROLES:
            raise RecordingError(
                f"topics: no role {role[:40]!r}{suggest_name(role, ROLES)}; there are"
                f" {', '.join(ROLES)}"
            )
        requested[role] = topic
    return requested


def select_topics(bag: Bag, requested: Mapping[str, str]) -> Roles:
    """Return the topic of each role: the given one, or the guessed one. Raises RecordingError: a
    topic that is not in the bag or of another kind, or no pictures in it; names those that there
    are."""
    roles = _guess_images(bag, requested)
    for role in ("left", "right", "depth"):
        _check_topic(bag, getattr(roles, role), role, IMAGE_TYPES)
    if not roles.left:
        raise RecordingError(f"{bag.path}: no topic of pictures; there are {bag.describe_topics()}")
    for role, of in (
        ("left_info", roles.left),
        ("right_info", roles.right),
        ("depth_info", roles.depth),
    ):
        if role in requested:
            _check_topic(bag, requested[role], role, CALIBRATION_TYPES)
        roles = replace(roles, **{role: requested.get(role) or _find_calibration_topic(bag, of)})
    pose = requested.get("pose")
    poses = _guess_poses(bag) if pose is None else () if pose == _NONE else (pose,)
    if pose not in (None, _NONE, TF):
        _check_topic(bag, pose, "pose", POSE_TYPES | TRANSFORM_TYPES)
        poses = (TF,) if bag.topics[pose].type in TRANSFORM_TYPES else poses
    is_requested, frame = pose is not None, requested.get("pose_frame")
    return replace(roles, poses=poses, pose_frame=frame, is_pose_requested=is_requested)


def _check_topic(bag: Bag, name: str | None, role: str, kinds: frozenset[str]) -> None:
    if not name:
        return
    if name not in bag.topics:
        raise RecordingError(
            f"{bag.path}: no topic {name} for {role}{suggest_name(name, list(bag.topics))}; there"
            f" are {bag.describe_topics()}"
        )
    if bag.topics[name].type not in kinds:
        raise RecordingError(
            f"{bag.path}: {name} is {bag.topics[name].type}, which cannot be {role}; there are"
            f" {bag.describe_topics()}"
        )


def _guess_images(bag: Bag, requested: Mapping[str, str]) -> Roles:
    """Return left, right and depth as given. If none is given: a pair, an image with depth, or an
    image."""
    is_given = "right" in requested or "depth" in requested
    if "left" in requested:
        right, depth = (requested.get(role) for role in ("right", "depth"))
        if not is_given:
            right = _find_right_topic(bag, requested["left"])
        right, depth = (None if name == _NONE else name for name in (right, depth))
        return Roles(requested["left"], right, depth)
    if is_given:
        raise RecordingError("topics: where right or depth is said, left must be, too")
    names = [
        name
        for name, topic in bag.topics.items()
        if topic.type in IMAGE_TYPES and not _contains_any(name, _NON_IMAGE_WORDS)
    ]
    images = sorted(
        (name for name in names if not _contains_any(name, _DEPTH_WORDS)),
        key=lambda name: _sort_key(bag, name),
    )
    pairs = [(name, right) for name in images if (right := _find_right_topic(bag, name))]
    if pairs:
        return Roles(*pairs[0])
    if not images:
        return Roles()
    depth = min(
        (name for name in names if _contains_any(name, _DEPTH_WORDS)),
        key=lambda name: (not is_registered(name), _sort_key(bag, name)),
        default=None,
    )
    if len(images) > 1:
        others = ", ".join(images[1:4])
        bag.notes.append(
            f"{bag.path}: of several topics of pictures {images[0]} is taken, not {others};"
            " --topics left=... says otherwise"
        )
    return Roles(images[0], None, depth)


def _sort_key(bag: Bag, name: str) -> tuple[bool, bool, bool, bool, int, str]:
    """Sort the better topic first: rectified, calibrated, of a colour camera, not compressed."""
    is_compressed = bag.topics[name].type in COMPRESSED_IMAGE_TYPES
    is_bare = _find_calibration_topic(bag, name) is None
    is_grey = not _contains_any(name, _COLOUR_WORDS)
    return not is_rectified(name), is_bare, is_grey, is_compressed, len(name), name


def _find_right_topic(bag: Bag, left: str) -> str | None:
    for side, other in _LEFT_RIGHT_NAMES:
        right = left.replace(side, other)
        if right != left and right in bag.topics and bag.topics[right].type in IMAGE_TYPES:
            return right
    return None


def _find_calibration_topic(bag: Bag, picture: str | None) -> str | None:
    """Return the topic on which drivers publish the calibration of a topic of images."""
    if not picture:
        return None
    base = next(
        (picture.removesuffix(end) for end in _TRANSPORT_SUFFIXES if picture.endswith(end)), picture
    )
    parent = base.rpartition("/")[0]
    # the last one is that of librealsense
    for place in (parent, base, f"{parent.rpartition('/')[0]}/info"):
        for name in (f"{place}/camera_info", f"{place}/calibration"):
            if name in bag.topics and bag.topics[name].type in CALIBRATION_TYPES:
                return name
    return None


def _guess_poses(bag: Bag) -> tuple[str, ...]:
    """Return ground truth by its name, then TF, then odometry, then other poses."""
    poses = sorted(name for name, topic in bag.topics.items() if topic.type in POSE_TYPES)
    truth = [name for name in poses if _contains_any(name, _TRUTH_WORDS)]
    odometry = [name for name in poses if bag.topics[name].type == "nav_msgs/msg/Odometry"]
    has_tf = any(
        topic.type in TRANSFORM_TYPES and "static" not in name for name, topic in bag.topics.items()
    )
    return tuple(dict.fromkeys([*truth, *([TF] if has_tf else []), *odometry, *poses]))


def is_rectified(topic: str) -> bool:
    """Return whether the name of a topic is that of rectified images (image_rect, but not
    direct)."""
    return re.search(r"(?<![a-z])rect", topic.lower()) is not None


def is_registered(depth: str) -> bool:
    """Return whether the name of a depth topic is that of depth in the colour camera's pixels."""
    return _contains_any(depth, _REGISTERED_WORDS)


def _contains_any(name: str, words: tuple[str, ...]) -> bool:
    return any(word in name.lower() for word in words)
