"""Read the topics and messages of a bag: one file, or a folder of the parts that a recorder
wrote."""

from __future__ import annotations

import importlib
import sys
from dataclasses import dataclass, field
from pathlib import Path

from topoloc import MissingExtraError, RecordingError
from topoloc.apps.formats.bags.message_file import MessageFile, MessageRef, Topic
from topoloc.plugin import natural_key

BAG_SUFFIXES = (".bag", ".bag.active", ".db3")
MCAP_SUFFIXES = (".mcap",)
_COMPRESSED_SUFFIX, _ZSTD_MAGIC = ".zstd", b"\x28\xb5\x2f\xfd"
_MAX_MESSAGE_BYTES = 1 << 29
# The first bytes of a file, and its reader, which is imported when it is needed.
_READERS = {
    b"#ROSBAG V2.0\n": ("ros1_file", "Ros1File"),
    b"\x89MCAP0\r\n": ("mcap_file", "McapFile"),
    b"SQLite format 3\0": ("sqlite_file", "SqliteFile"),
}


@dataclass(eq=False)
class Bag:
    """Hold the open files of a recording. `notes` are for the user, such as a file that is cut
    off."""

    path: Path
    files: list[MessageFile]
    topics: dict[str, Topic] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

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
        """Return the bytes of a message, or at least the first `most` of them, decompressed.

        Raises:
            RecordingError: the bytes do not exist.
        """
        file = self.files[ref.file]
        data = file.read(ref, most)
        return _decompress(file.read(ref)) if data.startswith(_ZSTD_MAGIC) else data

    def describe_topics(self) -> str:
        """Return the topics with their types, for errors."""
        names = [
            f"{topic.name} ({topic.type or topic.encoding})"
            for topic in sorted(self.topics.values(), key=lambda its: its.name)
        ]
        return (
            ", ".join(names[:40]) + (f" and {len(names) - 40} more" if len(names) > 40 else "")
            if names
            else "none"
        )

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
    """Open a bag. Only the positions of its messages are read.

    Raises:
        RecordingError: no bag, or damaged at its beginning.
        MissingExtraError: the extra `bags` is not installed.
    """
    paths = _list_parts(path) if path.is_dir() else [path]
    if not paths:
        packed = [
            part.name for part in sorted(path.iterdir()) if part.name.endswith(_COMPRESSED_SUFFIX)
        ]
        said = (
            f"{packed[0]} is packed as a whole: `zstd -d` unpacks it"
            if packed
            else "no .db3 and no .mcap file here"
        )
        raise RecordingError(f"{path}: {said}")
    return Bag(path, [_open_file(part) for part in paths])


def _list_parts(folder: Path) -> list[Path]:
    parts = [
        part
        for part in folder.iterdir()
        if part.suffix.lower() in (".db3", ".mcap") and part.is_file()
    ]
    return sorted(parts, key=lambda part: natural_key(part.name))


def _open_file(path: Path) -> MessageFile:
    try:
        with path.open("rb") as file:
            begin = file.read(16)
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from None
    for magic, (module, name) in _READERS.items():
        if begin.startswith(magic):
            try:
                return getattr(importlib.import_module(f"{__package__}.{module}"), name)(path)
            except ModuleNotFoundError as error:
                raise missing_bags_error(error, path) from error
    raise RecordingError(
        f"{path}: {'empty' if not begin else 'neither a ROS bag (2.0, or SQLite) nor an MCAP file'}"
    )


def missing_bags_error(error: ModuleNotFoundError, path: Path) -> Exception:
    """Return the error for a missing library of the extra."""
    if error.name is None or error.name.split(".")[0] not in (
        "rosbags",
        "mcap",
        "lz4",
        "zstandard",
        "google",
    ):
        return error
    return MissingExtraError(
        f"{path}: bags and MCAP files need the extra bags: pip install 'topoloc[bags]'"
    )


def _decompress(data: bytes) -> bytes:
    import zstandard

    try:
        return (
            zstandard.ZstdDecompressor()
            .stream_reader(data)
            .read(min(_MAX_MESSAGE_BYTES, sys.maxsize))
        )
    except zstandard.ZstdError:
        raise RecordingError("a packed message is damaged") from None
