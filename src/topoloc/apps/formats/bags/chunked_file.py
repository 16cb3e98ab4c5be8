"""Read files of records in chunks: the part that MCAP files and ROS 1 bags have in common.

Opening reads the headers of records and skips their content, because messages of images make up
most of a file. The readers of rosbags and mcap need the index at the end of a file, or read all of
it. Without this index, or if the file is cut off, the indexes behind the chunks are used. A chunk
without an index (the last one of such a file) is read itself.
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, NamedTuple

from topoloc.apps.formats.bags.chunks import WHOLE_FILE, Chunk, ChunkedBytes
from topoloc.apps.formats.bags.message_file import (
    MessageRef,
    Topic,
    TruncatedFileError,
    damaged_message_error,
)


class Record(NamedTuple):
    """A record: its type `op`, the positions of its first byte and of its data, their length, and
    the fields of a ROS 1 header."""

    op: int
    begin: int
    start: int
    length: int
    fields: dict[bytes, bytes]


@dataclass(eq=False)
class ChunkedFile(ABC):
    """The positions of all messages of a file. A subclass defines how records are read.

    `fault` is the reason if the file is not complete.
    """

    magic: ClassVar[bytes]
    message_op: ClassVar[int]
    index_op: ClassVar[int]
    chunk_op: ClassVar[int]
    damage_errors: ClassVar[tuple[type[Exception], ...]] = (
        TruncatedFileError,
        struct.error,
        UnicodeDecodeError,
        KeyError,
        IndexError,
    )

    path: Path
    topics: dict[str, Topic] = field(default_factory=dict)
    fault: str | None = None
    _channels: dict[int, Topic] = field(default_factory=dict)
    # For each channel: its indexes (chunk, position, length), and messages without an index.
    _indexes: dict[int, list[tuple[int, int, int]]] = field(default_factory=dict)
    _unindexed: dict[int, list[MessageRef]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._bytes = ChunkedBytes(self.path)
        self._scan_file()
        indexed = {chunk for found in self._indexes.values() for chunk, *_ in found}
        for chunk in range(len(self._bytes.chunks)):
            if chunk not in indexed:
                self._scan_chunk(chunk, self._add_message)
        first = {number: refs[0].chunk for number, refs in self._unindexed.items()}
        first |= {number: found[0][0] for number, found in self._indexes.items()}
        for number, chunk in first.items():
            if number not in self._channels:  # only its chunk defines it: the file has no summary
                self._scan_chunk(chunk, self._add_definition)
        for topic in self._channels.values():
            self.topics.setdefault(topic.name, topic)

    def messages(self, topic: str) -> list[MessageRef]:
        """Return the messages of a topic in the order in which they were written."""
        refs: list[MessageRef] = []
        for number in [number for number, its in self._channels.items() if its.name == topic]:
            refs += self._unindexed.get(number, [])
            for chunk, start, length in self._indexes.get(number, []):
                entries = self._parse_index(self._bytes.read(WHOLE_FILE, start, length))
                refs += [MessageRef(t_ns, chunk, offset) for t_ns, offset in entries]
        return sorted(refs)

    def read(self, ref: MessageRef, most: int | None = None) -> bytes:
        """Return the bytes of a message, or the first `most` of them. Raises RecordingError."""
        try:
            record = self._find_message(ref)
            if record.op != self.message_op or record.length < 0:
                raise TruncatedFileError
            length = record.length if most is None else min(record.length, most)
            return self._bytes.read(ref.chunk, record.start, length)
        except (StopIteration, *self.damage_errors):
            raise damaged_message_error(self.path.name, ref) from None

    def _scan_file(self) -> None:
        """Store the positions of chunks and their indexes, and the channels."""
        position, chunks = 0, self._bytes.chunks
        try:
            for record in self._iterate_records(WHOLE_FILE, len(self.magic)):
                position = record.start
                if record.op == self.chunk_op:
                    self._bytes.add(self._parse_chunk(record))
                elif record.op == self.index_op and chunks:
                    number, start, length = self._parse_index_header(record)
                    self._indexes.setdefault(number, []).append((len(chunks) - 1, start, length))
                else:
                    self._add_message(WHOLE_FILE, record)
                    self._add_definition(WHOLE_FILE, record)
        except self.damage_errors:
            self.fault = f"cut off or damaged after {position / 1e6:.3f} MB"

    def _scan_chunk(self, chunk: int, handler: Callable[[int, Record], None]) -> None:
        """Pass the records of a chunk to `handler`, up to the first damaged one."""
        try:
            for record in self._iterate_records(chunk, 0):
                handler(chunk, record)
        except self.damage_errors:
            return

    def _add_message(self, chunk: int, record: Record) -> None:
        if record.op == self.message_op:
            number, t_ns = self._parse_message_header(chunk, record)
            ref = MessageRef(t_ns, chunk, record.begin)
            self._unindexed.setdefault(number, []).append(ref)

    @abstractmethod
    def _iterate_records(self, chunk: int, position: int) -> Iterator[Record]:
        """Yield the complete records of a chunk, or of the file, from a position on. The last one
        may be a chunk that is cut off. Raises one of `damage_errors`."""

    @abstractmethod
    def _find_message(self, ref: MessageRef) -> Record:
        """Return the record of a message, without the header of its data."""

    @abstractmethod
    def _parse_chunk(self, record: Record) -> Chunk:
        """Return the position, sizes and compression of a chunk."""

    @abstractmethod
    def _parse_index_header(self, record: Record) -> tuple[int, int, int]:
        """Return the channel, position and length of an index."""

    @abstractmethod
    def _parse_index(self, data: bytes) -> list[tuple[int, int]]:
        """Return the time (nanoseconds) and the offset in its chunk of each entry."""

    @abstractmethod
    def _parse_message_header(self, chunk: int, record: Record) -> tuple[int, int]:
        """Return the channel and the time (nanoseconds) of a message."""

    @abstractmethod
    def _add_definition(self, chunk: int, record: Record) -> None:
        """Store the channel that a record defines, if it defines one."""
