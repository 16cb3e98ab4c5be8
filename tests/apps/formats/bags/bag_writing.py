"""Write recordings as bags with the formats' own libraries: rosbags for ROS 1 and 2,
mcap for MCAP."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import CompressionType, Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin, Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import StereoFrame, StereoSequence

LEFT, RIGHT = "/left/image_rect", "/right/image_rect"
FEATURE_TYPES = ("ros1", "ros1-lz4", "ros2", "ros2-mcap", "mcap-zstd")
SUFFIXES = {"ros1": ".bag", "ros1-lz4": ".bag", "ros2": "", "ros2-mcap": "", "mcap-zstd": ".mcap"}
ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS1.register(
    get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage")
)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
# Writes one message of a type to a topic: (topic, type, time in ns, fields).
Write = Callable[[str, str, int, dict[str, Any]], None]


def message(store: Any, kind: str, fields: dict[str, Any]) -> Any:
    """Return a message. Nested messages are dictionaries with the field names of ROS
    2 (d, k, r, p)."""
    made = {}
    for name, (node, of) in store.get_msgdef(kind).fields:
        value = fields.get(name, fields.get(name.lower(), 0 if name == "seq" else None))
        if node == 2 and value is not None:  # another message
            value = message(store, of, value)
        elif node in (3, 4) and value is not None and of[0][0] == 2:
            value = [message(store, of[0][1], item) for item in value]
        elif value is None and node == 2:
            value = message(store, of, {})
        elif value is None:
            value = (
                np.zeros(of[1])
                if node == 3
                else []
                if node == 4
                else ""
                if of[0] == "string"
                else False
                if of[0] == "bool"
                else 0
            )
        made[name] = value
    return store.types[kind](**made)


@contextmanager
def bag_writer(path: Path, kind: str) -> Iterator[Write]:
    """Yield a function that writes messages to a bag of this format."""
    if kind == "mcap-zstd":
        with _mcap_writer(path) as write:
            yield write
        return
    is_ros1, connections = kind.startswith("ros1"), {}
    store = ROS1 if is_ros1 else ROS2
    if is_ros1:
        writer = Ros1Writer(path)
        if kind == "ros1-lz4":
            writer.set_compression(Ros1Writer.CompressionFormat.LZ4)
    else:
        plugin = StoragePlugin.MCAP if kind == "ros2-mcap" else StoragePlugin.SQLITE3
        writer = Ros2Writer(path, version=9, storage_plugin=plugin)
    with writer:

        def write(topic: str, type_name: str, t_ns: int, fields: dict[str, Any], /) -> None:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_name, typestore=store)
            made = message(store, type_name, fields)
            data = (
                store.serialize_ros1(made, type_name)
                if is_ros1
                else store.serialize_cdr(made, type_name)
            )
            writer.write(connections[topic], t_ns, data)

        yield write


@contextmanager
def _mcap_writer(path: Path) -> Iterator[Write]:
    """Yield a function that writes ROS 2 messages with mcap's own writer, in chunks
    packed by zstd."""
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=200_000, compression=CompressionType.ZSTD)
        writer.start(profile="ros2")
        channels: dict[str, int] = {}

        def write(topic: str, type_name: str, t_ns: int, fields: dict[str, Any], /) -> None:
            if topic not in channels:
                text = ROS2.generate_msgdef(type_name, ros_version=2)[0].encode()
                channels[topic] = writer.register_channel(
                    topic, "cdr", writer.register_schema(type_name, "ros2msg", text)
                )
            data = bytes(ROS2.serialize_cdr(message(ROS2, type_name, fields), type_name))
            writer.add_message(channels[topic], t_ns, data, t_ns)

        yield write
        writer.finish()


def header(t_ns: int, frame: str = "left_optical") -> dict[str, Any]:
    sec, nanosec = divmod(t_ns, 1_000_000_000)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}


def image(
    pixels: np.ndarray, t_ns: int, encoding: str | None = None, frame: str = "left_optical"
) -> dict[str, Any]:
    """Return a sensor_msgs/Image with three bytes of padding after each row."""
    grey = f"mono{8 * pixels.itemsize}"
    encoding = encoding or (grey if pixels.ndim == 2 else "rgb8")
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
    data = np.pad(rows, ((0, 0), (0, 3)))
    fields = {
        "header": header(t_ns, frame),
        "height": pixels.shape[0],
        "width": pixels.shape[1],
        "encoding": encoding,
    }
    return fields | {"is_bigendian": 0, "step": data.shape[1], "data": data.ravel()}


def compressed(pixels: np.ndarray, t_ns: int, suffix: str = ".png") -> dict[str, Any]:
    """Return a sensor_msgs/CompressedImage."""
    bgr = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    return {
        "header": header(t_ns),
        "format": suffix[1:],
        "data": cv2.imencode(suffix, bgr)[1].ravel(),
    }


def info(
    camera: Camera, t_ns: int, baseline: float = 0.0, frame: str = "left_optical", **fields: Any
) -> dict[str, Any]:
    """Return a sensor_msgs/CameraInfo of a pinhole camera. `baseline` makes it the right
    camera of a pair."""
    k = camera.matrix()
    p = np.column_stack([k, [-camera.fx * baseline, 0.0, 0.0]])
    its = {
        "header": header(t_ns, frame),
        "height": camera.height,
        "width": camera.width,
        "distortion_model": "plumb_bob",
    }
    return its | {"d": np.zeros(5), "k": k.ravel(), "r": np.eye(3).ravel(), "p": p.ravel()} | fields


def transform(pose: Rigid3, t_ns: int, parent: str, child: str) -> dict[str, Any]:
    w, x, y, z = pose.quat_wxyz()
    tx, ty, tz = pose.translation
    rotation = {"x": x, "y": y, "z": z, "w": w}
    its = {"header": header(t_ns, parent), "child_frame_id": child}
    return its | {"transform": {"translation": {"x": tx, "y": ty, "z": tz}, "rotation": rotation}}


def as_pose(pose: Rigid3) -> dict[str, Any]:
    w, x, y, z = pose.quat_wxyz()
    tx, ty, tz = pose.translation
    return {
        "position": {"x": tx, "y": ty, "z": tz},
        "orientation": {"x": x, "y": y, "z": z, "w": w},
    }


def by_tf(write: Write, t_ns: int, world_from_cam: Rigid3) -> None:
    """Write the pose as TF: a moving body, and a camera fixed to it."""
    body_from_cam = Rigid3.exp(np.array([0.1, -0.2, 0.05, 0.3, 1.2, -0.4]))
    kind = "tf2_msgs/msg/TFMessage"
    write(
        "/tf",
        kind,
        t_ns,
        {
            "transforms": [
                transform(world_from_cam @ body_from_cam.inverse(), t_ns, "map", "base_link")
            ]
        },
    )
    write(
        "/tf_static",
        kind,
        t_ns,
        {"transforms": [transform(body_from_cam, t_ns, "base_link", "left_optical")]},
    )


def by_pose(write: Write, t_ns: int, world_from_cam: Rigid3) -> None:
    write(
        "/pose",
        "geometry_msgs/msg/PoseStamped",
        t_ns,
        {"header": header(t_ns, "map"), "pose": as_pose(world_from_cam)},
    )


def by_odometry(write: Write, t_ns: int, world_from_cam: Rigid3) -> None:
    fields = {
        "header": header(t_ns, "odom"),
        "child_frame_id": "left_optical",
        "pose": {"pose": as_pose(world_from_cam)},
    }
    write("/odom", "nav_msgs/msg/Odometry", t_ns, fields)


def write_stereo_bag(
    path: Path,
    kind: str,
    sequence: StereoSequence,
    poses: Callable[[Write, int, Rigid3], None] = by_tf,
    is_compressed: bool = False,
    factor: int = 0,
) -> Path:
    """Write rectified stereo pairs as a bag. Each message is written some milliseconds after its
    stamp. With a `factor`, pixels have 16 bits."""
    with bag_writer(path, kind) as write:
        for index in range(len(sequence)):
            frame = sequence[index]
            assert frame.right is not None
            assert frame.rig is not None
            now = frame.t_ns + 7_000_000 + index % 3 * 1_000_000
            for topic, pixels in ((LEFT, frame.image), (RIGHT, frame.right)):
                if factor:
                    pixels = pixels.astype(np.uint16) * factor
                if is_compressed:
                    write(
                        f"{topic}/compressed",
                        "sensor_msgs/msg/CompressedImage",
                        now,
                        compressed(pixels, frame.t_ns),
                    )
                else:
                    write(topic, "sensor_msgs/msg/Image", now, image(pixels, frame.t_ns))
            for topic, camera, baseline in (
                ("/left", frame.rig.left, 0.0),
                ("/right", frame.rig.right, frame.rig.baseline),
            ):
                write(
                    f"{topic}/camera_info",
                    "sensor_msgs/msg/CameraInfo",
                    now,
                    info(camera, frame.t_ns, baseline),
                )
            if frame.world_from_cam is not None:
                poses(write, frame.t_ns, frame.world_from_cam)
    return path


FOXGLOVE = {
    "CompressedImage": "/camera/image",
    "CameraCalibration": "/camera/calibration",
    "PoseInFrame": "/pose",
}


def write_foxglove(
    path: Path, sequence: StereoSequence, classes: dict[str, Any] | None = None
) -> Path:
    """Write the left images of a recording with Foxglove's schemas: as JSON, or as protobuf if
    `classes` is given."""
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        channels = {}
        for name, topic in FOXGLOVE.items():
            schema = (
                ("jsonschema", b"{}") if classes is None else ("protobuf", classes[name].file_set)
            )
            number = writer.register_schema(f"foxglove.{name}", *schema)
            channels[name] = writer.register_channel(
                topic, "json" if classes is None else "protobuf", number
            )
        for index in range(len(sequence)):
            t_ns = sequence.t_ns[index]
            for name, fields in _foxglove_fields(sequence[index]).items():
                data = (
                    _as_json(fields, t_ns)
                    if classes is None
                    else classes[name].written(fields, t_ns)
                )
                writer.add_message(channels[name], t_ns, data, t_ns)
        writer.finish()
    return path


def _foxglove_fields(frame: StereoFrame) -> dict[str, dict[str, Any]]:
    assert frame.camera is not None
    assert frame.world_from_cam is not None
    camera, k = frame.camera, frame.camera.matrix()
    matrices = {"D": [0.0] * 5, "K": k.ravel().tolist(), "R": np.eye(3).ravel().tolist()}
    matrices["P"] = np.column_stack([k, np.zeros(3)]).ravel().tolist()
    size = {
        "frame_id": "camera",
        "width": camera.width,
        "height": camera.height,
        "distortion_model": "plumb_bob",
    }
    return {
        "CompressedImage": {
            "frame_id": "camera",
            "data": cv2.imencode(".png", frame.image)[1].tobytes(),
            "format": "png",
        },
        "CameraCalibration": size | matrices,
        "PoseInFrame": {"frame_id": "map", "pose": as_pose(frame.world_from_cam)},
    }


def _as_json(fields: dict[str, Any], t_ns: int) -> bytes:
    sec, nsec = divmod(t_ns, 1_000_000_000)
    data = fields | {"timestamp": {"sec": sec, "nsec": nsec}}
    return json.dumps(
        {
            key: base64.b64encode(its).decode() if isinstance(its, bytes) else its
            for key, its in data.items()
        }
    ).encode()
