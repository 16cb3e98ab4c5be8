"""Announce a node to `ros2 node list` and `ros2 node info`: its name, and which readers and writers
are its own, on the topic of rmw. Needs `cyclonedds`, the extra `ros`."""

from __future__ import annotations

import threading
from contextlib import suppress
from typing import Any

from cyclonedds.core import DDSException, Entity, Policy, Qos
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from topoloc.apps.robots.ros_messages import GidSize, gid_kinds

TOPIC = "ros_discovery_info"
NODE_NAME = "topoloc"


class Announcement:
    """What a participant publishes about its node, again at each change. `reader` is that of the
    announcements of others: gids have 24 bytes once one of them has, else 16."""

    def __init__(self, participant: Any, namespace: str) -> None:
        self._participant, self._node = participant, (f"/{namespace}", NODE_NAME)
        self._readers, self._writers = list[bytes](), list[bytes]()
        self._lock = threading.Lock()
        self._qos = Qos(
            Policy.Reliability.Reliable(duration(milliseconds=100)),
            Policy.History.KeepLast(1),
            Policy.Durability.TransientLocal,
            Policy.IgnoreLocal.Participant,
        )
        topic = Topic(participant, TOPIC, GidSize, qos=self._qos)
        self.reader = DataReader(participant, topic, qos=self._qos)
        self._set_size(16)

    def add_reader(self, reader: Entity) -> None:
        """Announce a reader of the node."""
        with self._lock:
            self._readers.append(reader.guid.bytes)
            self._publish()

    def add_writer(self, writer: Entity) -> None:
        """Announce a writer of the node."""
        with self._lock:
            self._writers.append(writer.guid.bytes)
            self._publish()

    def hear(self, other: Any) -> None:
        """Announce the node as another one is announced, a `GidSize`."""
        with self._lock:
            if other.num_bytes > self._size:
                self._set_size(other.num_bytes)

    def _set_size(self, num_bytes: int) -> None:
        self._size, kind = num_bytes, gid_kinds(num_bytes).participant
        topic = Topic(self._participant, TOPIC, kind, qos=self._qos)
        self._writer = DataWriter(self._participant, topic, qos=self._qos)
        self._publish()

    def _publish(self) -> None:
        kinds, own = gid_kinds(self._size), self._participant.guid.bytes
        (gid,), *gids = (
            [kinds.gid(one.ljust(self._size, b"\0")) for one in some]
            for some in ([own], self._readers, self._writers)
        )
        with suppress(DDSException):  # a reader that hangs
            self._writer.write(kinds.participant(gid, [kinds.node(*self._node, *gids)]))
