"""Messages of ROS 2 for DDS, with the fields of their IDL (geometry_msgs, tf2_msgs, std_msgs,
sensor_msgs, diagnostic_msgs, rosgraph_msgs, builtin_interfaces, rmw_dds_common).

Type names and topics are those of rmw: `geometry_msgs::msg::dds_::Pose_`, and `rt/` before the name
of a topic. Needs `cyclonedds`, the extra `ros`.
"""

# No `from __future__ import annotations`: cyclonedds reads the types of the fields as they are.
import struct
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple, Self

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float64, int32, sequence, uint8, uint32

if TYPE_CHECKING:
    Covariance = list[float]
    Matrix3x3 = list[float]
    Matrix3x4 = list[float]
    Bytes = bytes
else:
    Covariance, Matrix3x3, Matrix3x4 = (array[float64, size] for size in (36, 9, 12))
    Bytes = sequence[uint8]


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Point(IdlStruct, typename="geometry_msgs::msg::dds_::Point_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Pose(IdlStruct, typename="geometry_msgs::msg::dds_::Pose_"):
    position: Point
    orientation: Quaternion


@dataclass
class PoseWithCovariance(IdlStruct, typename="geometry_msgs::msg::dds_::PoseWithCovariance_"):
    pose: Pose
    covariance: Covariance


@dataclass
class PoseWithCovarianceStamped(
    IdlStruct, typename="geometry_msgs::msg::dds_::PoseWithCovarianceStamped_"
):
    header: Header
    pose: PoseWithCovariance


@dataclass
class Transform(IdlStruct, typename="geometry_msgs::msg::dds_::Transform_"):
    translation: Vector3
    rotation: Quaternion


@dataclass
class TransformStamped(IdlStruct, typename="geometry_msgs::msg::dds_::TransformStamped_"):
    header: Header
    child_frame_id: str
    transform: Transform


@dataclass
class TFMessage(IdlStruct, typename="tf2_msgs::msg::dds_::TFMessage_"):
    transforms: sequence[TransformStamped]


@dataclass
class Clock(IdlStruct, typename="rosgraph_msgs::msg::dds_::Clock_"):
    clock: Time


@dataclass
class Imu(IdlStruct, typename="sensor_msgs::msg::dds_::Imu_"):
    header: Header
    orientation: Quaternion
    orientation_covariance: Matrix3x3
    angular_velocity: Vector3
    angular_velocity_covariance: Matrix3x3
    linear_acceleration: Vector3
    linear_acceleration_covariance: Matrix3x3


@dataclass
class ImageHead(IdlStruct, typename="topoloc::ImageHead_"):
    """The fields of an image before its data."""

    header: Header
    height: uint32
    width: uint32
    encoding: str
    is_bigendian: uint8
    step: uint32


@dataclass
class Image(IdlStruct, typename="sensor_msgs::msg::dds_::Image_"):
    header: Header
    height: uint32
    width: uint32
    encoding: str
    is_bigendian: uint8
    step: uint32
    data: Bytes

    @classmethod
    def deserialize(cls, data: bytes, has_header: bool = True, use_version_2: Any = None) -> Self:
        # cyclonedds makes a list of the bytes, which takes longer than tracking an image.
        head = ImageHead.deserialize(data, has_header, use_version_2)
        start = len(head.serialize())  # it ends with a number of 4 bytes, as the length is
        (size,) = struct.unpack_from("<I" if data[1] & 1 else ">I", data, start)
        shape = head.header, head.height, head.width
        layout = head.encoding, head.is_bigendian, head.step
        return cls(*shape, *layout, bytes(data[start + 4 : start + 4 + size]))


@dataclass
class CompressedImage(IdlStruct, typename="sensor_msgs::msg::dds_::CompressedImage_"):
    header: Header
    format: str
    data: Bytes


@dataclass
class RegionOfInterest(IdlStruct, typename="sensor_msgs::msg::dds_::RegionOfInterest_"):
    x_offset: uint32
    y_offset: uint32
    height: uint32
    width: uint32
    do_rectify: bool


@dataclass
class CameraInfo(IdlStruct, typename="sensor_msgs::msg::dds_::CameraInfo_"):
    header: Header
    height: uint32
    width: uint32
    distortion_model: str
    d: sequence[float64]
    k: Matrix3x3
    r: Matrix3x3
    p: Matrix3x4
    binning_x: uint32
    binning_y: uint32
    roi: RegionOfInterest


@dataclass
class KeyValue(IdlStruct, typename="diagnostic_msgs::msg::dds_::KeyValue_"):
    key: str
    value: str


@dataclass
class DiagnosticStatus(IdlStruct, typename="diagnostic_msgs::msg::dds_::DiagnosticStatus_"):
    level: uint8
    name: str
    message: str
    hardware_id: str
    values: sequence[KeyValue]


@dataclass
class DiagnosticArray(IdlStruct, typename="diagnostic_msgs::msg::dds_::DiagnosticArray_"):
    header: Header
    status: sequence[DiagnosticStatus]


@dataclass
class GidSize(IdlStruct, typename="rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_"):
    """How many bytes the gids of such a message have: 24 before ROS 2 Iron, the last 8 of them
    zero, and 16 since."""

    num_bytes: uint8

    @classmethod
    def deserialize(cls, data: bytes, has_header: bool = True, use_version_2: Any = None) -> Self:
        num_zeros, end_of_16 = 8, 20  # after the encapsulation: a gid, then the number of nodes
        rest = bytes(data[end_of_16 : end_of_16 + num_zeros])
        return cls(24 if rest == bytes(num_zeros) else 16)


class GidKinds(NamedTuple):
    """The classes of messages with gids of one size."""

    gid: Any
    node: Any
    participant: Any


@cache
def gid_kinds(size: int) -> GidKinds:
    """Return the classes of messages whose gids have `size` bytes."""

    @dataclass
    class Gid(IdlStruct, typename="rmw_dds_common::msg::dds_::Gid_"):
        data: array[uint8, size]  # pyright: ignore[reportInvalidTypeForm]

    @dataclass
    class NodeEntitiesInfo(IdlStruct, typename="rmw_dds_common::msg::dds_::NodeEntitiesInfo_"):
        node_namespace: str
        node_name: str
        reader_gid_seq: sequence[Gid]
        writer_gid_seq: sequence[Gid]

    @dataclass
    class ParticipantEntitiesInfo(
        IdlStruct, typename="rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_"
    ):
        gid: Gid
        node_entities_info_seq: sequence[NodeEntitiesInfo]

    return GidKinds(Gid, NodeEntitiesInfo, ParticipantEntitiesInfo)
