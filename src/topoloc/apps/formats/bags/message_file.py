"""Define the interface of a file of messages: its topics, the positions of messages, and their
bytes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

from topoloc import RecordingError


@dataclass(frozen=True)
class Topic:
    """A topic. `type` is written as in ROS 2 (``sensor_msgs/msg/Image``) or as in Foxglove
    (``foxglove.CompressedImage``).

    `encoding` of its messages is cdr, ros1, json or protobuf. `schema` is that of protobuf.
    """

    name: str
    type: str
    encoding: str
    schema: bytes = b""


class MessageRef(NamedTuple):
    """Hold the position of a message: the number of its chunk (-1: none) and the offset in it, or
    the row of a table. `log_t_ns` is the time of writing."""

    log_t_ns: int
    chunk: int
    offset: int
    file: int = 0


@runtime_checkable
class MessageFile(Protocol):
    """An open file of messages. Its index is in memory, its messages are not."""

    @property
    def topics(self) -> dict[str, Topic]:
        """The topics by name."""
        ...

    @property
    def fault(self) -> str | None:
        """The reason if the file is not complete. The messages before the fault are used."""
        ...

    def messages(self, topic: str) -> list[MessageRef]:
        """Return the messages of a topic in the order in which they were written."""
        ...

    def read(self, ref: MessageRef, most: int | None = None) -> bytes:
        """Return the bytes of a message, or the first `most` of them. Raises RecordingError."""
        ...


class TruncatedFileError(Exception):
    """The bytes do not exist: the file ends, or its index is damaged."""


def damaged_message_error(name: str, ref: MessageRef) -> RecordingError:
    """Return the error for a message that the index names and that does not exist."""
    place = (
        f"row {ref.offset}"
        if ref.chunk < -1
        else f"byte {ref.offset}" + (f" of chunk {ref.chunk}" if ref.chunk >= 0 else "")
    )
    return RecordingError(f"{name}: the message at {place} is damaged or cut off")
