"""Test Foxglove's messages as JSON and protobuf, the times of chunks, and invalid messages."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bag_writing import ROS1, ROS2, header, image, message, write_foxglove
from foxglove_classes import foxglove_classes

from topoloc.apps.formats.bags.bag import Topic
from topoloc.apps.formats.bags.messages import decode, decode_transforms, frame_id, header_stamp_ns
from topoloc.errors import RecordingError
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.open import open_sequence

IMAGE = "sensor_msgs/msg/Image"
NOW = 1_700_000_000_123_456_789


@pytest.mark.parametrize("encoding", ["json", "protobuf"])
def test_foxglove_recordings(encoding: str, walk: StereoSequence, tmp_path: Path):
    classes = foxglove_classes() if encoding == "protobuf" else None
    sequence = open_sequence(write_foxglove(tmp_path / "walk.mcap", walk, classes))
    assert sequence.t_ns == walk.t_ns
    for index in range(len(walk)):
        frame, original = sequence[index], walk[index]
        np.testing.assert_array_equal(frame.image, original.image)
        assert frame.camera == original.camera
        assert frame.world_from_cam is not None
        assert original.world_from_cam is not None
        np.testing.assert_allclose(
            frame.world_from_cam.matrix(), original.world_from_cam.matrix(), atol=1e-9
        )


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_the_time_of_a_beginning(encoding: str):
    fields = image(np.zeros((4, 4), np.uint8), NOW)
    data = bytes(
        ROS2.serialize_cdr(message(ROS2, IMAGE, fields), IMAGE)
        if encoding == "cdr"
        else _ros1(fields)
    )
    topic = Topic("/a", IMAGE, encoding)
    assert header_stamp_ns(topic, data[:32]) == NOW
    assert frame_id(decode(topic, data)) == "left_optical"
    assert header_stamp_ns(topic, data[:5]) is None
    with pytest.raises(RecordingError, match="/a: no whole message of type sensor_msgs/msg/Image"):
        decode(topic, data[:40])


def _ros1(fields: dict[str, object]) -> memoryview:
    return ROS1.serialize_ros1(message(ROS1, IMAGE, fields), IMAGE)


def test_messages_that_cannot_be_read():
    with pytest.raises(RecordingError, match="encoded as cbor cannot be read"):
        decode(Topic("/a", IMAGE, "cbor"), b"123")
    with pytest.raises(RecordingError, match="no whole message of type nav/msg/Unknown"):
        decode(Topic("/a", "nav/msg/Unknown", "cdr"), b"123")
    with pytest.raises(RecordingError, match="not poses"):
        decode_transforms(
            Topic("/a", "foxglove.PoseInFrame", "json"),
            b'{"timestamp": {"sec": 1, "nsec": 2}, "frame_id": "map", "pose": 7}',
        )
    with pytest.raises(RecordingError, match="no whole message"):
        decode(Topic("/a", "foxglove.PoseInFrame", "json"), b"[" * 100_000)


@pytest.mark.parametrize("orientation", [{"w": 0.0}, {"w": 0.5}, {"w": float("nan")}])
def test_a_pose_without_a_rotation(orientation: dict[str, float]):
    kind = "geometry_msgs/msg/PoseStamped"
    fields = {"header": header(NOW, "map"), "pose": {"orientation": orientation}}
    with pytest.raises(RecordingError, match="/pose: not poses"):
        decode_transforms(
            Topic("/pose", kind, "cdr"),
            bytes(ROS2.serialize_cdr(message(ROS2, kind, fields), kind)),
        )
