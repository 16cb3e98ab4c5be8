"""What a file of messages is, whatever its container: topics, where each message lies, and its
bytes when they are asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

from topoloc import RecordingError


@dataclass(frozen=True)
class Topic:
    """A topic: `type` as ROS 2 writes it (``sensor_msgs/msg/Image``) or Foxglove's
    (``foxglove.CompressedImage``).

    `encoding` is how its messages are written: cdr, ros1, json or protobuf; `schema` what protobuf
    is decoded by.
    """

    name: str
    type: str
    encoding: str
    schema: bytes = b""


class MessageRef(NamedTuple):
    """Where a message lies: the chunk's number (-1: in none) and the place in it, or a table's row.
    `log_t_ns`: when it was written."""

    log_t_ns: int
    chunk: int
    offset: int
    file: int = 0


@runtime_checkable
class MessageFile(Protocol):
    """A file of messages, opened: its index is in memory, its messages are not."""

    @property
    def topics(self) -> dict[str, Topic]:
        """The topics by name."""
        ...

    @property
    def fault(self) -> str | None:
        """Why the file is not whole, where it is not: what comes before is used."""
        ...

    def messages(self, topic: str) -> list[MessageRef]:
        """The messages of a topic, in the order in which they were written."""
        ...

    def read(self, ref: MessageRef, most: int | None = None) -> bytes:
        """The bytes of a message, or the first `most` of them. Raises RecordingError."""
        ...


class TruncatedFileError(Exception):
    """The bytes asked for are not there: the file ends, or what says so is damaged."""


def damaged_message_error(name: str, ref: MessageRef) -> RecordingError:
    """What is said of a message that the index names and that is not there."""
    place = (
        f"row {ref.offset}"
        if ref.chunk < -1
        else f"byte {ref.offset}" + (f" of chunk {ref.chunk}" if ref.chunk >= 0 else "")
    )
    return RecordingError(f"{name}: the message at {place} is damaged or cut off")
