"""Define the fields that tests use of Foxglove's protobuf schemas for images, calibrations and
poses (github.com/foxglove/schemas)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from google.protobuf import (
    descriptor_pb2,
    descriptor_pool,
    json_format,
    message_factory,
    timestamp_pb2,
)

_FIELDS: dict[str, list[tuple[str, int, str]]] = {
    "Vector3": [("x", 1, "double"), ("y", 2, "double"), ("z", 3, "double")],
    "Quaternion": [("x", 1, "double"), ("y", 2, "double"), ("z", 3, "double"), ("w", 4, "double")],
    "Pose": [("position", 1, ".foxglove.Vector3"), ("orientation", 2, ".foxglove.Quaternion")],
    "CompressedImage": [
        ("timestamp", 1, "time"),
        ("frame_id", 4, "string"),
        ("data", 2, "bytes"),
        ("format", 3, "string"),
    ],
    "CameraCalibration": [
        ("timestamp", 1, "time"),
        ("frame_id", 9, "string"),
        ("width", 2, "fixed32"),
        ("height", 3, "fixed32"),
        ("distortion_model", 4, "string"),
        ("D", 5, "doubles"),
        ("K", 6, "doubles"),
        ("R", 7, "doubles"),
        ("P", 8, "doubles"),
    ],
    "PoseInFrame": [
        ("timestamp", 1, "time"),
        ("frame_id", 2, "string"),
        ("pose", 3, ".foxglove.Pose"),
    ],
}
_KINDS = {"double": 1, "doubles": 1, "string": 9, "bytes": 12, "fixed32": 7}


@dataclass(frozen=True)
class MessageClass:
    """Hold a message type and the descriptors that a file of its messages contains."""

    made_by: Any
    file_set: bytes

    def written(self, fields: dict[str, Any], t_ns: int) -> bytes:
        """Return the bytes of a message with these fields and this time."""
        message = json_format.ParseDict(
            {key: value for key, value in fields.items() if key != "data"}, self.made_by()
        )
        message.timestamp.seconds, message.timestamp.nanos = divmod(t_ns, 1_000_000_000)
        if "data" in fields:
            message.data = fields["data"]
        return message.SerializeToString()


def foxglove_classes() -> dict[str, MessageClass]:
    """Return the message types by name, without the prefix `foxglove.`."""
    file = descriptor_pb2.FileDescriptorProto(
        name="foxglove.proto", package="foxglove", syntax="proto3"
    )
    file.dependency.append("google/protobuf/timestamp.proto")
    for name, fields in _FIELDS.items():
        message = file.message_type.add(name=name)
        for field_name, number, kind in fields:
            field = message.field.add(
                name=field_name,
                number=number,
                label=3 if kind == "doubles" else 1,
                json_name=field_name,
            )
            field.type = _KINDS.get(kind, 11)  # pyright: ignore[reportAttributeAccessIssue]
            if kind not in _KINDS:
                field.type_name = ".google.protobuf.Timestamp" if kind == "time" else kind
    times = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(times)
    file_set = descriptor_pb2.FileDescriptorSet(file=[times, file])
    pool = descriptor_pool.DescriptorPool()
    for part in file_set.file:
        pool.Add(part)  # pyright: ignore[reportAttributeAccessIssue]
    found = {name: pool.FindMessageTypeByName(f"foxglove.{name}") for name in _FIELDS}
    return {
        name: MessageClass(message_factory.GetMessageClass(its), file_set.SerializeToString())
        for name, its in found.items()
    }
