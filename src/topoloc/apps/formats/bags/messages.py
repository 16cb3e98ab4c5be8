"""Decode messages of cameras and poses of ROS 1, ROS 2 and Foxglove to one form.

rosbags decodes the types of ROS: sensor_msgs, geometry_msgs, nav_msgs and tf2_msgs. The schemas of
Foxglove are JSON or protobuf.
"""

from __future__ import annotations

import base64
import json
import math
import struct
from dataclasses import dataclass
from functools import cache, lru_cache
from types import SimpleNamespace
from typing import Any

from topoloc import RecordingError
from topoloc.apps.formats.bags.bag import Topic

RAW_IMAGE_TYPES = frozenset({"sensor_msgs/msg/Image", "foxglove.RawImage"})
COMPRESSED_IMAGE_TYPES = frozenset({"sensor_msgs/msg/CompressedImage", "foxglove.CompressedImage"})
IMAGE_TYPES = RAW_IMAGE_TYPES | COMPRESSED_IMAGE_TYPES
CALIBRATION_TYPES = frozenset({"sensor_msgs/msg/CameraInfo", "foxglove.CameraCalibration"})
TRANSFORM_TYPES = frozenset(
    {
        "tf2_msgs/msg/TFMessage",
        "tf/msg/tfMessage",
        "foxglove.FrameTransform",
        "foxglove.FrameTransforms",
    }
)
POSE_TYPES = frozenset(
    {
        "nav_msgs/msg/Odometry",
        "geometry_msgs/msg/PoseStamped",
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        "geometry_msgs/msg/TransformStamped",
        "foxglove.PoseInFrame",
    }
)
_STAMP_FIELDS = (("sec", "nanosec"), ("sec", "nsec"), ("secs", "nsecs"), ("seconds", "nanos"))
_NANOSECONDS = 1_000_000_000
_HEADER_BYTES = 32
# metres; and the largest difference of a quaternion's length from 1
_MAX_TRANSLATION, _ROTATION_TOLERANCE = 1e9, 1e-2


@dataclass(frozen=True)
class StampedTransform:
    """Hold the pose of `child` in `parent` at a time: translation in metres, quaternion x y z w.
    `child` may be empty."""

    t_ns: int
    parent: str
    child: str
    translation: tuple[float, float, float]
    quat_xyzw: tuple[float, float, float, float]


def decode(topic: Topic, data: bytes) -> Any:
    """Return a message with its fields as attributes. Raises RecordingError: an encoding that is
    not known, or bytes that are no message of the topic's type."""
    try:
        if topic.encoding in ("cdr", "ros1"):
            # The known definition of the type is used, not the one in the file.
            store = _typestore(topic.encoding)
            kind = topic.type.replace("tf/msg/tfMessage", "tf2_msgs/msg/TFMessage")
            is_cdr = topic.encoding == "cdr"
            return (store.deserialize_cdr if is_cdr else store.deserialize_ros1)(data, kind)
        if topic.encoding == "json":
            return json.loads(data, object_hook=lambda fields: SimpleNamespace(**fields))
        if topic.encoding == "protobuf":
            return _protobuf_class(topic.type, topic.schema).FromString(data)
    except (RecordingError, ModuleNotFoundError):
        raise
    except Exception as error:  # decoders raise many classes for damaged bytes
        raise RecordingError(
            f"{topic.name}: no whole message of type {topic.type} ({type(error).__name__})"
        ) from None
    raise RecordingError(
        f"{topic.name}: messages encoded as {topic.encoding or 'nothing'} cannot be read"
    )


def num_header_bytes(topic: Topic) -> int | None:
    """Return the number of bytes of a message that contain its time. None means all."""
    return None if topic.encoding == "json" else _HEADER_BYTES


def header_stamp_ns(topic: Topic, header: bytes) -> int | None:
    """Return the time (nanoseconds) in the first bytes of a message that begins with a header. None
    if it has none."""
    try:
        if topic.encoding == "cdr":
            seconds, nanoseconds = struct.unpack_from("<iI" if header[1] & 1 else ">iI", header, 4)
        elif topic.encoding == "ros1":
            seconds, nanoseconds = struct.unpack_from("<II", header, 4)
        elif topic.encoding == "protobuf" and header[:1] == b"\x0a":  # field 1, a Timestamp
            from google.protobuf.timestamp_pb2 import Timestamp

            stamp = Timestamp.FromString(header[2 : 2 + header[1]])
            seconds, nanoseconds = stamp.seconds, stamp.nanos
        elif topic.encoding == "json":
            return stamp_ns(decode(topic, header).timestamp)
        else:
            return None
    except ModuleNotFoundError:
        raise
    except Exception:  # as in `decode`
        return None
    t_ns = seconds * _NANOSECONDS + nanoseconds
    return t_ns if 0 <= t_ns < 1 << 63 else None


def stamp_ns(stamp: Any) -> int:
    """Return the nanoseconds of a time. ROS, JSON and protobuf name its fields differently."""
    for seconds, nanoseconds in _STAMP_FIELDS:
        if hasattr(stamp, seconds) and hasattr(stamp, nanoseconds):
            return int(getattr(stamp, seconds)) * _NANOSECONDS + int(getattr(stamp, nanoseconds))
    raise RecordingError("a message without a time")


def frame_id(message: Any) -> str:
    """Return the frame of a message."""
    return _frame_name(message.header.frame_id if hasattr(message, "header") else message.frame_id)


def _frame_name(text: Any) -> str:
    """Return the name without the leading slash of older ROS and without unprintable characters."""
    return "".join(letter for letter in str(text) if letter.isprintable()).lstrip("/")


def image_bytes(message: Any) -> bytes:
    """Return the data of an image."""
    return base64.b64decode(message.data) if isinstance(message.data, str) else bytes(message.data)


def decode_transforms(topic: Topic, data: bytes) -> list[StampedTransform]:
    """Return the transforms of a TF message, or the one of a pose message. Raises RecordingError:
    no whole message of this type, or numbers that are no pose."""
    message = decode(topic, data)
    try:
        return [stamped_transform(part) for part in getattr(message, "transforms", [message])]
    except (AttributeError, TypeError, ValueError, OverflowError):
        raise RecordingError(f"{topic.name}: not poses, or not as {topic.type} has them") from None


def stamped_transform(part: Any) -> StampedTransform:
    """Return the transform of a part of a message. Raises ValueError: its numbers are no pose."""
    stamp = stamp_ns(part.header.stamp if hasattr(part, "header") else part.timestamp)
    has_parent = hasattr(part, "parent_frame_id")
    parent = _frame_name(part.parent_frame_id) if has_parent else frame_id(part)
    child = _frame_name(getattr(part, "child_frame_id", ""))
    inner = getattr(part, "transform", None) or getattr(part, "pose", part)
    inner = getattr(inner, "pose", inner)  # with covariance
    position = inner.position if hasattr(inner, "position") else inner.translation
    rotation = inner.orientation if hasattr(inner, "orientation") else inner.rotation
    translation = (float(position.x), float(position.y), float(position.z))
    quat_xyzw = (float(rotation.x), float(rotation.y), float(rotation.z), float(rotation.w))
    is_near = all(abs(value) < _MAX_TRANSLATION for value in translation)
    if not (is_near and abs(math.hypot(*quat_xyzw) - 1.0) <= _ROTATION_TOLERANCE):
        raise ValueError
    return StampedTransform(stamp, parent, child, translation, quat_xyzw)


@cache
def _typestore(encoding: str) -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE if encoding == "cdr" else Stores.ROS1_NOETIC)
    if encoding == "ros1":
        definition = "geometry_msgs/TransformStamped[] transforms"
        store.register(get_types_from_msg(definition, "tf2_msgs/msg/TFMessage"))
    return store


@lru_cache(maxsize=32)
def _protobuf_class(name: str, schema: bytes) -> Any:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema).file:
        pool.AddSerializedFile(file.SerializeToString())
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
