"""Read the topics and messages of a bag: one file, or a folder of the parts that a recorder
wrote."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, Protocol, TypeVar, runtime_checkable

from topoloc import MissingExtraError, RecordingError
from topoloc.apps.formats.bags.bag_clock import Clock
from topoloc.plugin import natural_key

BAG_SUFFIXES = (".bag", ".bag.active", ".db3")
MCAP_SUFFIXES = (".mcap",)
T = TypeVar("T")
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_MAX_MESSAGE_BYTES = 1 << 29
# The first bytes of a file, and its reader, which is imported when it is needed.
_READERS = {
    b"#ROSBAG V2.0\n": ("ros1_file", "Ros1File"),
    b"\x89MCAP0\r\n": ("mcap_file", "McapFile"),
    b"SQLite format 3\0": ("sqlite_file", "SqliteFile"),
}


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

    @property
    def place(self) -> tuple[int, int, int]:
        """Its place in the order of writing."""
        return self.file, self.chunk, self.offset


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
    place = f"row {ref.offset}" if ref.chunk < -1 else f"byte {ref.offset}"
    place += f" of chunk {ref.chunk}" if ref.chunk >= 0 else ""
    return RecordingError(f"{name}: the message at {place} is damaged or cut off")


@dataclass(eq=False)
class Bag:
    """Hold the open files of a recording. `notes` are for the user, such as a file that is cut
    off. `clock` is that of the header times."""

    path: Path
    files: list[MessageFile]
    topics: dict[str, Topic] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    clock: Clock = field(default_factory=Clock)

    def __post_init__(self) -> None:
        for file in self.files:
            for name, topic in file.topics.items():
                if f"{name}{topic.type}{topic.encoding}".isprintable():  # else damaged
                    self.topics.setdefault(name, topic)

    def messages(self, topic: str) -> list[MessageRef]:
        """Return the messages of a topic in all files, in the order in which they were written."""
        found = [
            (number, file.messages(topic))
            for number, file in enumerate(self.files)
            if topic in file.topics
        ]
        return sorted(ref._replace(file=number) for number, refs in found for ref in refs)

    def read(self, ref: MessageRef, most: int | None = None) -> bytes:
        """Return the bytes of a message, or at least the first `most` of them, decompressed. Raises
        RecordingError: the bytes do not exist."""
        file = self.files[ref.file]
        data = file.read(ref, most)
        return _decompress(file.read(ref)) if data.startswith(_ZSTD_MAGIC) else data

    def describe_topics(self) -> str:
        """Return the topics with their types, for errors."""
        topics = sorted(self.topics.values(), key=lambda topic: topic.name)
        names = [f"{topic.name} ({topic.type or topic.encoding})" for topic in topics]
        more = f" and {len(names) - 40} more" if len(names) > 40 else ""
        return (", ".join(names[:40]) + more) or "none"

    def parse_messages(
        self, topic: str, parse: Callable[[Topic, bytes], T], most: int | None = None
    ) -> tuple[list[tuple[MessageRef, T]], int]:
        """Return the messages of a topic with their positions, parsed from at least their first
        `most` bytes, and the number of damaged ones. They are read in the order of the file, which
        decompresses a chunk once, and returned in the order in which they were written."""
        parsed, num_damaged = list[tuple[MessageRef, T]](), 0
        for ref in sorted(self.messages(topic), key=lambda ref: ref.place):
            try:
                parsed.append((ref, parse(self.topics[topic], self.read(ref, most))))
            except RecordingError:
                num_damaged += 1
        return sorted(parsed, key=lambda pair: pair[0]), num_damaged

    def note_damaged(self, num_damaged: int, topic: str) -> None:
        """Note that messages of a topic were skipped, if any."""
        if num_damaged:
            text = f"{num_damaged} messages of {topic} are damaged and left out"
            self.notes.append(f"{self.path}: {text}")

    def add_fault_notes(self) -> None:
        """Add the faults of the files to `notes`. Call it after the messages were listed."""
        self.notes += [
            f"{self.path}: {file.fault}; what is whole is used" for file in self.files if file.fault
        ]


def is_bag(path: Path, suffixes: tuple[str, ...] = BAG_SUFFIXES) -> bool:
    """Return whether this is a file with one of these suffixes, or a folder of files that ROS 2
    recorded."""
    if path.is_dir():
        return suffixes == BAG_SUFFIXES and bool(
            (path / "metadata.yaml").is_file() or _list_parts(path)
        )
    return path.name.lower().endswith(suffixes) and path.is_file()


def open_bag_files(path: Path) -> Bag:
    """Open a bag. Only the positions of its messages are read. Raises RecordingError: no bag, or
    damaged at its beginning; MissingExtraError: the extra `bags` is not installed."""
    paths = _list_parts(path) if path.is_dir() else [path]
    if not paths:
        packed = min((part.name for part in path.glob("*.zstd")), default=None)
        fault = f"{packed} is packed as a whole: `zstd -d` unpacks it"
        raise RecordingError(f"{path}: {fault if packed else 'no .db3 and no .mcap file here'}")
    return Bag(path, [_open_file(part) for part in paths])


def _list_parts(folder: Path) -> list[Path]:
    files = (part for part in folder.iterdir() if part.suffix.lower() in (".db3", ".mcap"))
    return sorted(filter(Path.is_file, files), key=lambda part: natural_key(part.name))


def _open_file(path: Path) -> MessageFile:
    with RecordingError.at(path, OSError), path.open("rb") as file:
        begin = file.read(16)
    for magic, (module, name) in _READERS.items():
        if begin.startswith(magic):
            try:
                return getattr(importlib.import_module(f"{__package__}.{module}"), name)(path)
            except ModuleNotFoundError as error:
                raise missing_bags_error(error, path) from error
    fault = "neither a ROS bag (2.0, or SQLite) nor an MCAP file" if begin else "empty"
    raise RecordingError(f"{path}: {fault}")


def missing_bags_error(error: ModuleNotFoundError, path: Path) -> Exception:
    """Return the error for a missing library of the extra."""
    names = ("rosbags", "mcap", "lz4", "zstandard", "google")
    if (error.name or "").split(".")[0] not in names:
        return error
    need = "bags and MCAP files need the extra bags: pip install 'topoloc[bags]'"
    return MissingExtraError(f"{path}: {need}")


def _decompress(data: bytes) -> bytes:
    import zstandard

    try:
        return zstandard.ZstdDecompressor().stream_reader(data).read(_MAX_MESSAGE_BYTES)
    except zstandard.ZstdError:
        raise RecordingError("a packed message is damaged") from None
