"""A node of ROS 2 by DDS alone: topics with ROS's names and qualities of service, and a thread that
calls back for each message."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Literal

from topoloc import MissingExtraError, TopolocError
from topoloc.apps.robots.config import RobotConfig

Quality = Literal["sensor", "reliable", "latched"]


class RosNode:
    """A participant of a ROS 2 domain until it is closed.

    Raises MissingExtraError: cyclonedds is not installed; TopolocError: there is no such domain, or
    no network for DDS.
    """

    def __init__(self, config: RobotConfig) -> None:
        with MissingExtraError.on_import("ROS needs cyclonedds", "ros"):
            from cyclonedds import core, domain

            from topoloc.apps.robots import ros_messages
        self.messages: Any = ros_messages
        self._core, self._namespace = core, config.namespace.strip("/")
        self.domain = _find_domain(config)
        try:
            self._participant = domain.DomainParticipant(self.domain)
        except core.DDSException:
            raise TopolocError(
                f"ROS domain {self.domain}: DDS has no network here; connect one, or name an"
                " interface in CYCLONEDDS_URI"
            ) from None
        self._callbacks: list[tuple[Any, Callable[[Any], None]]] = []
        self._waitset = core.WaitSet(self._participant)
        self._is_closed = threading.Event()
        self._thread = threading.Thread(target=self._spin, name="ros", daemon=True)

    def topic_name(self, name: str) -> str:
        """Return the DDS name of a topic. A name without leading slash is in the namespace."""
        inside = f"{self._namespace}/{name}" if self._namespace else name
        return f"rt/{name[1:] if name.startswith('/') else inside}"

    def create_writer(self, name: str, kind: Any) -> Callable[[Any], None]:
        """Return a function that publishes a message, reliably."""
        from cyclonedds.pub import DataWriter
        from cyclonedds.topic import Topic

        qos = self._quality("reliable")
        topic = Topic(self._participant, self.topic_name(name), kind, qos=qos)
        return DataWriter(self._participant, topic, qos=qos).write

    def create_reader(
        self,
        name: str,
        kind: Any,
        quality: Quality,
        callback: Callable[[Any], None] | None = None,
    ) -> Any:
        """Return a reader. `callback` gets each message, in the thread of `start`."""
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        core, qos = self._core, self._quality(quality)
        topic = Topic(self._participant, self.topic_name(name), kind, qos=qos)
        reader = DataReader(self._participant, topic, qos=qos)
        if callback is not None:
            states = core.ViewState.Any | core.InstanceState.Alive | core.SampleState.NotRead
            condition = core.ReadCondition(reader, states)
            self._waitset.attach(condition)
            self._callbacks.append((reader, callback))
        return reader

    def start(self) -> None:
        """Begin to call back."""
        self._thread.start()

    def close(self) -> None:
        """End the thread and leave the domain."""
        self._is_closed.set()
        if self._thread.is_alive():
            self._thread.join(1.0)
        self._callbacks.clear()
        del self._waitset, self._participant

    def _spin(self) -> None:
        while not self._is_closed.is_set():
            self._waitset.wait(50_000_000)
            for reader, callback in self._callbacks:
                for message in take(reader, 100):
                    with suppress(ValueError, TypeError, OverflowError, TopolocError):
                        callback(message)  # of a message whose numbers mean nothing

    def _quality(self, quality: Quality) -> Any:
        """Return the QoS: that of sensor data, that of most topics, or that of /tf_static."""
        from cyclonedds.core import Policy, Qos
        from cyclonedds.util import duration

        if quality == "sensor":
            return Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(5))
        reliable = Policy.Reliability.Reliable(duration(milliseconds=100))
        ignored = Policy.IgnoreLocal.Participant
        history = Policy.History.KeepLast(100)
        if quality == "latched":
            return Qos(reliable, history, Policy.Durability.TransientLocal, ignored)
        return Qos(reliable, history, ignored)


def take(reader: Any, num: int) -> list[Any]:
    """Return the messages that have arrived, at most `num`. Damaged ones are left out."""
    messages = list[Any]()
    for _ in range(num):
        try:
            taken = reader.take(1)
        except Exception:  # decoders raise many classes for damaged bytes
            continue
        if not taken:
            break
        messages += [one for one in taken if one.sample_info.valid_data]
    return messages


def _find_domain(config: RobotConfig) -> int:
    if config.domain is not None:
        return config.domain
    text = os.environ.get("ROS_DOMAIN_ID", "").strip() or "0"
    if not (text.isascii() and text.isdigit() and int(text) <= 232):
        raise TopolocError(f"ROS_DOMAIN_ID={text[:40]!r}: a number from 0 to 232 is expected")
    return int(text)
