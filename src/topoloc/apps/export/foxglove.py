"""MCAP with Foxglove's schemas (Protobuf), for viewers of robot logs. Needs the extra `bags`.

Topics: `/camera` PoseInFrame, `/camera/calibration` CameraCalibration, `/camera/image`
CompressedImage, `/tf` FrameTransform (map to camera), `/camera/fix` LocationFix of georeferenced
maps; and once `/path` PosesInFrame and `/points` PointCloud.
https://docs.foxglove.dev/docs/sdk/schemas
"""

from __future__ import annotations

import importlib
import io
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np

from topoloc import MissingExtraError, Rigid3
from topoloc.apps.viewer.scene import Scene, View, image_type

MAP_FRAME, CAMERA_FRAME = "map", "camera"
_STEP_NS = 1_000_000_000


def to_mcap(scene: Scene) -> bytes:
    """Return a log. If times are missing or decrease, views are one second apart from 0. Raises
    MissingExtraError: `mcap` or Foxglove's schemas are not installed."""
    with MissingExtraError.on_import("MCAP needs mcap and Foxglove's schemas", "bags"):
        from mcap_protobuf.writer import Writer

        _schema("PoseInFrame")
    views, times = _assign_times(scene)
    buffer = io.BytesIO()
    with Writer(buffer) as writer:

        def write(topic: str, message: Any, t_ns: int) -> None:
            writer.write_message(topic, message, log_time=t_ns, publish_time=t_ns)

        poses = [_to_pose(pose) for pose in scene.trajectory]
        path = _message("PosesInFrame", times[0], MAP_FRAME, poses=poses)
        write("/path", path, times[0])
        if len(scene.points.world):
            write("/points", _to_point_cloud(scene, times[0]), times[0])
        for view, t_ns in zip(views, times, strict=True):
            for topic, message in _view_messages(view, t_ns):
                write(topic, message, t_ns)
    return buffer.getvalue()


def _schema(name: str) -> Any:
    """Return a message class of Foxglove."""
    return getattr(importlib.import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)


def _message(name: str, t_ns: int, frame_id: str, **fields: Any) -> Any:
    """Create a message with a time and a frame."""
    return _schema(name)(timestamp=_to_timestamp(t_ns), frame_id=frame_id, **fields)


def _assign_times(scene: Scene) -> tuple[list[View], list[int]]:
    views = sorted(scene.views, key=lambda view: view.t_ns or 0)
    times = [view.t_ns if view.t_ns is not None else -1 for view in views]
    if min(times) >= 0 and all(after >= before for before, after in pairwise(times)):
        return views, times
    return list(scene.views), [number * _STEP_NS for number in range(len(views))]


def _view_messages(view: View, t_ns: int) -> Iterator[tuple[str, Any]]:
    """Yield the topics and messages of a view."""
    pose = _to_pose(view.world_from_cam)
    yield "/camera", _message("PoseInFrame", t_ns, MAP_FRAME, pose=pose)
    frames = {"parent_frame_id": MAP_FRAME, "child_frame_id": CAMERA_FRAME}
    moved = {"translation": pose.position, "rotation": pose.orientation}
    yield "/tf", _schema("FrameTransform")(timestamp=_to_timestamp(t_ns), **frames, **moved)
    camera = view.image_camera or view.camera
    if camera is not None:
        k = camera.matrix()
        model = "kannala_brandt" if camera.is_fisheye else "rational_polynomial"
        size = {"width": camera.width, "height": camera.height, "distortion_model": model}
        matrices = {"K": k, "R": np.eye(3), "P": np.column_stack([k, np.zeros(3)])}
        numbers = {name: value.ravel().tolist() for name, value in matrices.items()}
        numbers["D"] = camera.distortion().tolist()
        yield (
            "/camera/calibration",
            _message("CameraCalibration", t_ns, CAMERA_FRAME, **size, **numbers),
        )
    if view.image:
        image = {"data": view.image, "format": image_type(view.image)}
        yield "/camera/image", _message("CompressedImage", t_ns, CAMERA_FRAME, **image)
    if view.geopose is not None:
        place = view.geopose.position
        fix = {"latitude": place.lat, "longitude": place.lon, "altitude": place.h}
        yield "/camera/fix", _message("LocationFix", t_ns, CAMERA_FRAME, **fix)


def _to_point_cloud(scene: Scene, t_ns: int) -> Any:
    element = _schema("PackedElementField")
    points = np.zeros(len(scene.points.world), [("xyz", "<f4", 3), ("rgba", "u1", 4)])
    origin = scene.points.world.mean(axis=0).round()  # 32 bits are too few for those of the earth
    points["xyz"], points["rgba"] = scene.points.world - origin, 255
    points["rgba"][:, :3] = scene.points.rgb
    fields = [
        element(name=name, offset=4 * k, type=element.FLOAT32) for k, name in enumerate("xyz")
    ] + [
        element(name=name, offset=12 + k, type=element.UINT8)
        for k, name in enumerate(("red", "green", "blue", "alpha"))
    ]
    content = {"point_stride": points.itemsize, "fields": fields, "data": points.tobytes()}
    return _message(
        "PointCloud", t_ns, MAP_FRAME, pose=_to_pose(Rigid3(np.eye(3), origin)), **content
    )


def _to_timestamp(t_ns: int) -> Any:
    from google.protobuf.timestamp_pb2 import Timestamp

    return Timestamp(seconds=t_ns // _STEP_NS, nanos=t_ns % _STEP_NS)


def _to_pose(world_from_cam: Rigid3) -> Any:
    x, y, z = world_from_cam.translation.tolist()
    qw, qx, qy, qz = world_from_cam.quat_wxyz().tolist()
    return _schema("Pose")(
        position=_schema("Vector3")(x=x, y=y, z=z),
        orientation=_schema("Quaternion")(x=qx, y=qy, z=qz, w=qw),
    )
