"""MCAP with Foxglove's schemas (Protobuf), for Foxglove and other viewers of robots' logs. Needs
the extra `bags`.

Topics: `/camera` foxglove.PoseInFrame, `/camera/calibration` CameraCalibration, `/camera/image`
CompressedImage, `/tf` FrameTransform (map to camera), `/camera/fix` LocationFix of places on earth,
and once `/path` PosesInFrame and `/points` PointCloud. https://docs.foxglove.dev/docs/sdk/schemas
"""

from __future__ import annotations

import io
import struct
from itertools import pairwise
from typing import Any

import numpy as np

from topoloc import MissingExtraError, Rigid3
from topoloc.apps.viewer.scene import Scene, View

MAP_FRAME, CAMERA_FRAME = "map", "camera"
_CHANNELS = ("red", "green", "blue", "alpha")
_STEP_NS = 1_000_000_000
_MODELS = {True: "kannala_brandt", False: "rational_polynomial"}


def to_mcap(scene: Scene) -> bytes:
    """A whole log; where views have no times, or those of two do not increase, they are a second
    apart from 0.

    Raises:
        MissingExtraError: `mcap` or Foxglove's schemas are not installed.
    """
    try:
        from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
        from mcap_protobuf.writer import Writer
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            "MCAP needs mcap and Foxglove's schemas: pip install 'topoloc[bags]'"
        ) from error
    views, times = _assign_times(scene)
    buffer = io.BytesIO()
    with Writer(buffer) as writer:

        def write(topic: str, message: Any, t_ns: int) -> None:
            writer.write_message(topic, message, log_time=t_ns, publish_time=t_ns)

        write("/path", _to_path(scene, times[0]), times[0])
        if len(scene.points.world):
            write("/points", _to_point_cloud(scene, times[0]), times[0])
        for view, t_ns in zip(views, times, strict=True):
            write(
                "/camera",
                PoseInFrame(
                    timestamp=_to_timestamp(t_ns),
                    frame_id=MAP_FRAME,
                    pose=_to_pose(view.world_from_cam),
                ),
                t_ns,
            )
            for topic, message in _view_messages(view, t_ns):
                write(topic, message, t_ns)
    return buffer.getvalue()


def _assign_times(scene: Scene) -> tuple[list[View], list[int]]:
    views = sorted(scene.views, key=lambda view: view.t_ns or 0)
    times = [view.t_ns if view.t_ns is not None else -1 for view in views]
    if min(times) >= 0 and all(after >= before for before, after in pairwise(times)):
        return views, times
    return list(scene.views), [number * _STEP_NS for number in range(len(views))]


def _view_messages(view: View, t_ns: int) -> list[tuple[str, Any]]:
    from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
    from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
    from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix

    pose, stamp = _to_pose(view.world_from_cam), _to_timestamp(t_ns)
    frames = {"parent_frame_id": MAP_FRAME, "child_frame_id": CAMERA_FRAME}
    messages: list[tuple[str, Any]] = [
        (
            "/tf",
            FrameTransform(
                timestamp=stamp,
                **frames,
                translation=_to_vector(view.world_from_cam),
                rotation=pose.orientation,
            ),
        )
    ]
    camera = view.jpeg_camera or view.camera
    if camera is not None:
        k = camera.matrix()
        calibration = CameraCalibration(
            timestamp=stamp,
            frame_id=CAMERA_FRAME,
            width=camera.width,
            height=camera.height,
            distortion_model=_MODELS[camera.is_fisheye],
            D=camera.distortion().tolist(),
            K=k.ravel().tolist(),
            R=np.eye(3).ravel().tolist(),
            P=np.column_stack([k, np.zeros(3)]).ravel().tolist(),
        )
        messages.append(("/camera/calibration", calibration))
    if view.jpeg:
        messages.append(
            (
                "/camera/image",
                CompressedImage(
                    timestamp=stamp, frame_id=CAMERA_FRAME, data=view.jpeg, format="jpeg"
                ),
            )
        )
    if view.geopose is not None:
        place = view.geopose.position
        fix = LocationFix(
            timestamp=stamp,
            frame_id=CAMERA_FRAME,
            latitude=place.lat,
            longitude=place.lon,
            altitude=place.h,
        )
        messages.append(("/camera/fix", fix))
    return messages


def _to_path(scene: Scene, t_ns: int) -> Any:
    from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame

    return PosesInFrame(
        timestamp=_to_timestamp(t_ns),
        frame_id=MAP_FRAME,
        poses=[_to_pose(pose) for pose in scene.trajectory],
    )


def _to_point_cloud(scene: Scene, t_ns: int) -> Any:
    from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
    from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

    points = np.zeros(len(scene.points.world), [("xyz", "<f4", 3), ("rgba", "u1", 4)])
    points["xyz"], points["rgba"][:, :3], points["rgba"][:, 3] = (
        scene.points.world,
        scene.points.rgb,
        255,
    )
    fields = [
        PackedElementField(name=name, offset=4 * k, type=PackedElementField.FLOAT32)
        for k, name in enumerate("xyz")
    ]
    fields += [
        PackedElementField(name=name, offset=12 + k, type=PackedElementField.UINT8)
        for k, name in enumerate(_CHANNELS)
    ]
    origin = _to_pose(Rigid3.identity())
    step = struct.calcsize("<fffBBBB")
    return PointCloud(
        timestamp=_to_timestamp(t_ns),
        frame_id=MAP_FRAME,
        pose=origin,
        point_stride=step,
        fields=fields,
        data=points.tobytes(),
    )


def _to_timestamp(t_ns: int) -> Any:
    from google.protobuf.timestamp_pb2 import Timestamp

    return Timestamp(seconds=t_ns // _STEP_NS, nanos=t_ns % _STEP_NS)


def _to_vector(world_from_cam: Rigid3) -> Any:
    from foxglove_schemas_protobuf.Vector3_pb2 import Vector3

    x, y, z = world_from_cam.translation.tolist()
    return Vector3(x=x, y=y, z=z)


def _to_pose(world_from_cam: Rigid3) -> Any:
    from foxglove_schemas_protobuf.Pose_pb2 import Pose
    from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion

    w, x, y, z = world_from_cam.quat_wxyz().tolist()
    return Pose(position=_to_vector(world_from_cam), orientation=Quaternion(x=x, y=y, z=z, w=w))
