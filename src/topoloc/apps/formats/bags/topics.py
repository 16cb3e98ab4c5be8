"""Which topic of a bag is what: guessed by types and by the names that drivers give, or said by
``--topics``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

from topoloc.apps.formats.bags.bag import Bag
from topoloc.apps.formats.bags.messages import CALIBRATIONS, COMPRESSED, PICTURES, POSES, TRANSFORMS
from topoloc.bounds import did_you_mean
from topoloc.errors import RecordingError

ROLES = ("left", "right", "depth", "left_info", "right_info", "depth_info", "pose", "pose_frame")
_ALSO = {
    "image": "left",
    "mono": "left",
    "color": "left",
    "camera_info": "left_info",
    "info": "left_info",
}
_NONE, TF = "none", "tf"
# What tells the topic of a left picture from that of the right one.
_SIDES = (
    ("left", "right"),
    ("infra1", "infra2"),
    ("cam0", "cam1"),
    ("camera0", "camera1"),
    ("cam_0", "cam_1"),
    ("image_0", "image_1"),
    ("Infrared_1", "Infrared_2"),
)
_DEPTH, _NO_PICTURE = ("depth",), ("disparity", "confidence", "mask", "segmentation", "thermal")
_REGISTERED, _COLOUR, _TRUTH = (
    ("aligned", "registered"),
    ("color", "colour", "rgb"),
    ("truth", "gt", "mocap", "vicon", "optitrack"),
)
_TRANSPORTS = ("/compressedDepth", "/compressed")


@dataclass(frozen=True)
class Roles:
    """The topic of each role, where there is one. `poses` are tried in order, and may be `tf`;
    `pose_frame` is the frame they are of."""

    left: str = ""
    right: str | None = None
    depth: str | None = None
    left_info: str | None = None
    right_info: str | None = None
    depth_info: str | None = None
    poses: tuple[str, ...] = ()
    pose_frame: str | None = None
    is_pose_said: bool = False


def parse_topics(text: str) -> dict[str, str]:
    """``left=/cam0/image_raw,pose=/odom`` as a dictionary.

    Raises:
        RecordingError: not of this form, or a role that there is not.
    """
    said: dict[str, str] = {}
    for part in text.split(","):
        role, is_one, topic = (piece.strip() for piece in part.partition("="))
        role = _ALSO.get(role, role)
        if not is_one or not topic:
            raise RecordingError(
                f"topics {part.strip()[:80]!r}: ROLE=TOPIC is expected, as in left=/cam0/image_raw"
            )
        if role not in ROLES:
            raise RecordingError(
                f"topics: no role {role[:40]!r}{did_you_mean(role, ROLES)}; there are"
                f" {', '.join(ROLES)}"
            )
        said[role] = topic
    return said


def choose_topics(bag: Bag, said: Mapping[str, str]) -> Roles:
    """The topic of each role: what is said, and for the others what is guessed.

    Raises:
        RecordingError: a topic that is not in the bag or of another kind, or no pictures in it;
            names those that there are.
    """
    roles = _guessed_pictures(bag, said)
    for role, kinds in (
        ("left", PICTURES),
        ("right", PICTURES),
        ("depth", PICTURES),
        ("left_info", CALIBRATIONS),
    ):
        _check(bag, getattr(roles, role), role, kinds)
    if not roles.left:
        raise RecordingError(f"{bag.path}: no topic of pictures; there are {bag.listed()}")
    for role, of in (
        ("left_info", roles.left),
        ("right_info", roles.right),
        ("depth_info", roles.depth),
    ):
        if role in said:
            _check(bag, said[role], role, CALIBRATIONS)
        roles = replace(roles, **{role: said.get(role) or _calibration_of(bag, of)})
    pose = said.get("pose")
    poses = _guessed_poses(bag) if pose is None else () if pose == _NONE else (pose,)
    if pose not in (None, _NONE, TF):
        _check(bag, pose, "pose", POSES | TRANSFORMS)
        poses = (TF,) if bag.topics[pose].type in TRANSFORMS else poses
    return replace(
        roles, poses=poses, pose_frame=said.get("pose_frame"), is_pose_said=pose is not None
    )


def _check(bag: Bag, name: str | None, role: str, kinds: frozenset[str]) -> None:
    if name is None or name == "":
        return
    if name not in bag.topics:
        raise RecordingError(
            f"{bag.path}: no topic {name} for {role}{did_you_mean(name, list(bag.topics))}; there"
            f" are {bag.listed()}"
        )
    if bag.topics[name].type not in kinds:
        raise RecordingError(
            f"{bag.path}: {name} is {bag.topics[name].type}, which cannot be {role}; there are"
            f" {bag.listed()}"
        )


def _guessed_pictures(bag: Bag, said: Mapping[str, str]) -> Roles:
    """What is said of left, right and depth; where nothing is, a pair, or a picture with depth, or
    a picture."""
    if "left" in said:
        right, depth = (
            None if said.get(role) == _NONE else said.get(role) for role in ("right", "depth")
        )
        if "right" not in said and "depth" not in said:
            right = _right_of(bag, said["left"])
        return Roles(said["left"], right, depth)
    if "right" in said or "depth" in said:
        raise RecordingError("topics: where right or depth is said, left must be, too")
    names = [
        name
        for name, topic in bag.topics.items()
        if topic.type in PICTURES and not _has(name, _NO_PICTURE)
    ]
    pictures = sorted(
        (name for name in names if not _has(name, _DEPTH)), key=lambda name: _rank(bag, name)
    )
    pairs = [(name, right) for name in pictures if (right := _right_of(bag, name))]
    if pairs:
        return Roles(*pairs[0])
    depths = sorted(
        (name for name in names if _has(name, _DEPTH)),
        key=lambda name: (not is_registered(name), _rank(bag, name)),
    )
    if not pictures:
        return Roles()
    if len(pictures) > 1:
        others = ", ".join(pictures[1:4])
        bag.notes.append(
            f"{bag.path}: of several topics of pictures {pictures[0]} is taken, not {others};"
            " --topics left=... says otherwise"
        )
    return Roles(pictures[0], None, depths[0] if depths else None)


def _rank(bag: Bag, name: str) -> tuple[bool, bool, bool, bool, int, str]:
    """Sorts the better topic first: rectified, calibrated, of a colour camera, not compressed."""
    is_compressed = bag.topics[name].type in COMPRESSED
    return (
        not is_rectified(name),
        _calibration_of(bag, name) is None,
        not _has(name, _COLOUR),
        is_compressed,
        len(name),
        name,
    )


def _right_of(bag: Bag, left: str) -> str | None:
    for side, other in _SIDES:
        right = left.replace(side, other)
        if right != left and right in bag.topics and bag.topics[right].type in PICTURES:
            return right
    return None


def _calibration_of(bag: Bag, picture: str | None) -> str | None:
    """The topic that drivers publish the calibration of a topic of pictures on."""
    if not picture:
        return None
    base = next(
        (picture.removesuffix(end) for end in _TRANSPORTS if picture.endswith(end)), picture
    )
    parent = base.rpartition("/")[0]
    for place in (
        parent,
        base,
        f"{parent.rpartition('/')[0]}/info",
    ):  # the last is how librealsense records
        for name in (f"{place}/camera_info", f"{place}/calibration"):
            if name in bag.topics and bag.topics[name].type in CALIBRATIONS:
                return name
    return None


def _guessed_poses(bag: Bag) -> tuple[str, ...]:
    """Truth by its name, then TF, then odometry, then other poses."""
    poses = sorted(name for name, topic in bag.topics.items() if topic.type in POSES)
    truth = [name for name in poses if _has(name, _TRUTH)]
    odometry = [name for name in poses if bag.topics[name].type == "nav_msgs/msg/Odometry"]
    has_tf = any(
        topic.type in TRANSFORMS and "static" not in name for name, topic in bag.topics.items()
    )
    return tuple(dict.fromkeys([*truth, *([TF] if has_tf else []), *odometry, *poses]))


def is_rectified(topic: str) -> bool:
    """Whether the name of a topic says that its pictures are rectified (image_rect, but not
    direct)."""
    return re.search(r"(?<![a-z])rect", topic.lower()) is not None


def is_registered(depth: str) -> bool:
    """Whether the name of a topic of depth says that it is of the colour camera's pixels."""
    return _has(depth, _REGISTERED)


def _has(name: str, words: tuple[str, ...]) -> bool:
    return any(word in name.lower() for word in words)
