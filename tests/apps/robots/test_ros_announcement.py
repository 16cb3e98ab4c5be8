"""Test what ROS reads of a node: a second participant takes the bytes of its announcement."""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from topoloc.apps.robots.config import RobotConfig
from topoloc.apps.robots.ros_node import RosNode

pytest.importorskip("cyclonedds", reason="the extra ros is not installed")
from cyclonedds.builtin import (
    BuiltinDataReader,
    BuiltinTopicDcpsParticipant,
    BuiltinTopicDcpsPublication,
    BuiltinTopicDcpsSubscription,
)
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from topoloc.apps.robots.ros_messages import GidSize, gid_kinds

DOMAIN = 100 + os.getpid() % 100  # tests run side by side
QOS = Qos(
    Policy.Reliability.Reliable(duration(seconds=1)),
    Policy.History.KeepLast(1),
    Policy.Durability.TransientLocal,
)


@pytest.fixture
def node() -> Iterator[RosNode]:
    node = RosNode(RobotConfig(domain=DOMAIN, namespace="robot1"))
    yield node
    node.close()


class Peer:
    """A participant that reads announcements as bytes, with gids of `size` bytes."""

    def __init__(self, size: int, monkeypatch: pytest.MonkeyPatch) -> None:
        self.participant, self.bytes = DomainParticipant(DOMAIN), list[bytes]()
        kind = gid_kinds(size).participant
        read = kind.deserialize

        def deserialize(data: bytes, *rest: Any, **named: Any) -> Any:
            self.bytes.append(bytes(data))
            return read(data, *rest, **named)

        monkeypatch.setattr(kind, "deserialize", deserialize)
        topic = Topic(self.participant, "ros_discovery_info", kind, qos=QOS)
        self._reader = DataReader(self.participant, topic, qos=QOS)

    def announce(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Publish that the participant has no node, with gids of 24 bytes."""
        data = b"\0\1\0\0" + self.participant.guid.bytes.ljust(24, b"\0") + struct.pack("<I", 0)
        monkeypatch.setattr(GidSize, "serialize", lambda *_, **__: data)
        topic = Topic(self.participant, "ros_discovery_info", GidSize, qos=QOS)
        self._writer = DataWriter(self.participant, topic, qos=QOS)
        self._writer.write(GidSize(0))

    def last(self, is_enough: Callable[[bytes], bool]) -> bytes:
        """Return the first announcement that suffices."""
        end = time.monotonic() + 20.0
        while time.monotonic() < end:
            self._reader.take(1)
            if self.bytes and is_enough(self.bytes[-1]):
                return self.bytes[-1]
            time.sleep(0.02)
        pytest.fail(f"no such announcement; the last is {self.bytes[-1:]}")

    def found(self, kind: Any, is_enough: Callable[[list[Any]], bool]) -> list[Any]:
        """Return the samples of a builtin topic once they suffice."""
        end, reader, samples = time.monotonic() + 20.0, None, list[Any]()
        while time.monotonic() < end and not is_enough(samples):
            reader = BuiltinDataReader(self.participant, kind)
            samples = reader.take(100)
            time.sleep(0.02)
        return samples

    def guids(self, kind: Any, participant: bytes, *topics: str) -> list[bytes]:
        """Return those that DDS itself gives to a participant's endpoints of these topics."""

        def by_topic(samples: list[Any]) -> dict[str, bytes]:
            own = [one for one in samples if one.participant_key.bytes == participant]
            return {one.topic_name: one.key.bytes for one in own}

        found = by_topic(self.found(kind, lambda one: set(topics) <= set(by_topic(one))))
        return [found[name] for name in topics]


def _by_hand(participant: bytes, readers: list[bytes], writers: list[bytes], size: int) -> bytes:
    """Return the message in CDR, little endian, as rmw_dds_common defines it."""

    def gids(some: list[bytes]) -> bytes:
        return struct.pack("<I", len(some)) + b"".join(one.ljust(size, b"\0") for one in some)

    names = struct.pack("<I8sI8s", 8, b"/robot1\0", 8, b"topoloc\0")
    message = participant.ljust(size, b"\0") + struct.pack("<I", 1) + names
    return b"\0\1\0\0" + message + gids(readers) + gids(writers)


@pytest.mark.parametrize("size", [16, 24])
def test_another_participant_reads_the_node_and_its_topics(
    size: int, node: RosNode, monkeypatch: pytest.MonkeyPatch
):
    """A ROS before Iron, whose gids have 24 bytes, announces itself with them."""
    ros = node.messages
    kept = [
        node.create_writer("/tf", ros.TFMessage),
        node.create_reader("/clock", ros.Clock, "sensor"),
        node.create_reader("/initialpose", ros.PoseWithCovarianceStamped, "reliable"),
    ]
    peer = Peer(size, monkeypatch)
    if size == 24:
        peer.announce(monkeypatch)
    length = len(_by_hand(b"", [b""] * 2, [b""], size))
    data = peer.last(lambda one: len(one) == length)
    own = data[4:20]
    readers = peer.guids(BuiltinTopicDcpsSubscription, own, "rt/clock", "rt/initialpose")
    writers = peer.guids(BuiltinTopicDcpsPublication, own, "rt/tf")
    assert data == _by_hand(own, readers, writers, size)
    assert len(kept) == 3  # DDS forgets those that Python does


def test_later_topics_are_announced_again(node: RosNode, monkeypatch: pytest.MonkeyPatch):
    peer = Peer(16, monkeypatch)
    first = peer.last(lambda one: b"topoloc" in one)
    node.create_writer("/tf", node.messages.TFMessage)
    assert len(peer.last(lambda one: one != first)) == len(first) + 16


def test_the_participant_says_that_it_is_of_ros(node: RosNode, monkeypatch: pytest.MonkeyPatch):
    """rmw lists no participant without the enclave in its user data."""
    peer = Peer(16, monkeypatch)
    own = peer.last(lambda one: b"topoloc" in one)[4:20]

    def is_known(samples: list[Any]) -> bool:
        return own in [one.key.bytes for one in samples]

    found = peer.found(BuiltinTopicDcpsParticipant, is_known)
    (qos,) = [one.qos for one in found if one.key.bytes == own]
    assert qos[Policy.Userdata] == Policy.Userdata(b"enclave=/;")


@pytest.mark.parametrize(("size", "num_nodes"), [(16, 0), (16, 1), (24, 0), (24, 1)])
def test_the_size_of_gids_is_read_from_the_bytes(size: int, num_nodes: int):
    kinds = gid_kinds(size)
    gid = kinds.gid(bytes(range(16)).ljust(size, b"\0"))
    nodes = [kinds.node("/", "talker", [gid], [])] * num_nodes
    assert GidSize.deserialize(kinds.participant(gid, nodes).serialize()).num_bytes == size


def test_gids_of_others_never_make_the_own_ones_shorter(
    node: RosNode, monkeypatch: pytest.MonkeyPatch
):
    from topoloc.apps.robots.ros_announcement import Announcement

    participant = DomainParticipant(DOMAIN)
    announcement = Announcement(participant, "")
    for size in (24, 16):
        announcement.hear(GidSize(size))
    peer = Peer(24, monkeypatch)
    data = peer.last(lambda one: b"topoloc" in one)
    assert data[4:28] == participant.guid.bytes + bytes(8)


@pytest.mark.parametrize(("distro", "size"), [("humble", 24), ("iron", 16), ("jazzy", 16)])
def test_the_definitions_of_ros_give_the_same_bytes(distro: str, size: int):
    typesys = pytest.importorskip("rosbags.typesys", reason="the extra bags is not installed")
    store = typesys.get_typestore(typesys.Stores[f"ROS2_{distro.upper()}"])
    kinds, name = gid_kinds(size), "rmw_dds_common/msg/ParticipantEntitiesInfo"
    gid = kinds.gid(bytes(range(16)).ljust(size, b"\0"))
    node = kinds.node("/robot1", "topoloc", [gid], [gid, gid])
    data = kinds.participant(gid, [node]).serialize()
    read = store.deserialize_cdr(data, name)
    assert read.node_entities_info_seq[0].node_name == "topoloc"
    assert bytes(store.serialize_cdr(read, name)) == data
