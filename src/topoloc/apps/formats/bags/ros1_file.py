"""ROS 1 bags (format 2.0, wiki.ros.org/Bags/Format/2.0), gone through record by record without
their messages.

The index at the end of the file is not needed, so a bag that was never closed (``.bag.active``), or
was cut off, is read as any other.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from topoloc.apps.formats.bags.chunks import WHOLE_FILE, Chunk, ChunkedBytes
from topoloc.apps.formats.bags.message_file import (
    MessageRef,
    Topic,
    TruncatedFileError,
    damaged_message_error,
)

MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG, _INDEX, _CHUNK, _CONNECTION = 2, 3, 4, 5, 7
_MAX_HEADER_BYTES = 1 << 20
_U32 = struct.Struct("<I")
_INDEX_ENTRY = np.dtype([("s", "<u4"), ("ns", "<u4"), ("offset", "<u4")])
_DAMAGE_ERRORS = (TruncatedFileError, struct.error, UnicodeDecodeError, KeyError, IndexError)


class _Record(NamedTuple):
    """A record: its header's fields, where it begins, and where its data lie."""

    fields: dict[bytes, bytes]
    begin: int
    start: int
    length: int

    @property
    def op(self) -> int:
        return self.fields[b"op"][0]

    def number(self, name: bytes) -> int:
        return _U32.unpack(self.fields[name])[0]


@dataclass(eq=False)
class Ros1File:
    """A ROS 1 bag, by what its records say of where things are."""

    path: Path
    topics: dict[str, Topic] = field(default_factory=dict)
    fault: str | None = None
    _bytes: ChunkedBytes = field(init=False)
    _connections: dict[int, Topic] = field(default_factory=dict)
    # Of each connection: (chunk, where its index lies, its length in bytes), and messages that no
    # index names.
    _indexes: dict[int, list[tuple[int, int, int]]] = field(default_factory=dict)
    _unindexed: dict[int, list[MessageRef]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._bytes = ChunkedBytes(self.path)
        indexed = self._scan()
        for chunk in range(len(self._bytes.chunks)):
            if chunk not in indexed:
                self._scan_chunk(chunk, self._add_message)
        for number in [*self._indexes, *self._unindexed]:
            if (
                number not in self._connections
            ):  # described within chunks alone: the index at the end is missing
                chunk = (
                    self._indexes[number][0][0]
                    if number in self._indexes
                    else self._unindexed[number][0].chunk
                )
                self._scan_chunk(chunk, self._add_connection)
        for topic in self._connections.values():
            self.topics.setdefault(topic.name, topic)

    def messages(self, topic: str) -> list[MessageRef]:
        """The messages of a topic, in the order in which they were written."""
        refs: list[MessageRef] = []
        for number in (number for number, its in self._connections.items() if its.name == topic):
            refs += self._unindexed.get(number, [])
            for chunk, start, length in self._indexes.get(number, []):
                entries = np.frombuffer(self._bytes.read(WHOLE_FILE, start, length), _INDEX_ENTRY)
                refs += [
                    MessageRef(s * 1_000_000_000 + ns, chunk, offset)
                    for s, ns, offset in entries.tolist()
                ]
        return sorted(refs)

    def read(self, ref: MessageRef, most: int | None = None) -> bytes:
        """The bytes of a message, or the first `most` of them. Raises RecordingError."""
        try:
            record = next(
                record
                for record in self._iterate_records(ref.chunk, ref.offset)
                if record.op != _CONNECTION
            )
            if record.op != _MESSAGE:
                raise TruncatedFileError
            return self._bytes.read(
                ref.chunk, record.start, record.length if most is None else min(record.length, most)
            )
        except (StopIteration, *_DAMAGE_ERRORS):
            raise damaged_message_error(self.path.name, ref) from None

    def _iterate_records(self, chunk: int, position: int) -> Iterator[_Record]:
        """Each record from here on that is whole; the last may be a chunk whose end is missing."""
        end = self._bytes.readable_size(chunk)
        while position < end:
            begin = position
            (length,) = _U32.unpack(self._bytes.read(chunk, begin, 4))
            if length > _MAX_HEADER_BYTES:
                raise TruncatedFileError
            header = self._bytes.read(chunk, begin + 4, length + 4)
            record = _Record(
                _fields(header[:-4]), begin, begin + length + 8, _U32.unpack(header[-4:])[0]
            )
            position = record.start + record.length
            if position > end and record.op != _CHUNK:
                raise TruncatedFileError
            yield record
        if position > end:
            raise TruncatedFileError

    def _scan(self) -> set[int]:
        """Notes what the records of the file say; the chunks that have an index."""
        indexed: set[int] = set()
        position, is_closed = 0, False
        try:
            for record in self._iterate_records(WHOLE_FILE, len(MAGIC)):
                position, chunk = record.start, len(self._bytes.chunks) - 1
                if record.op == _BAG:
                    is_closed = any(record.fields[b"index_pos"])
                elif record.op == _CHUNK:
                    self._add_chunk(record)
                elif record.op == _INDEX and chunk >= 0:
                    size = record.length // _INDEX_ENTRY.itemsize * _INDEX_ENTRY.itemsize
                    self._indexes.setdefault(record.number(b"conn"), []).append(
                        (chunk, record.start, size)
                    )
                    indexed.add(chunk)
                else:
                    self._add_connection(WHOLE_FILE, record)
            if not is_closed:
                self.fault = "never closed by its recorder"
        except _DAMAGE_ERRORS:
            self.fault = f"cut off or damaged after {position / 1e6:.3f} MB"
        return indexed

    def _scan_chunk(self, chunk: int, handler: Callable[[int, _Record], None]) -> None:
        """Goes through the records of one chunk, as far as it is whole."""
        try:
            for record in self._iterate_records(chunk, 0):
                handler(chunk, record)
        except _DAMAGE_ERRORS:
            return

    def _add_chunk(self, record: _Record) -> None:
        self._bytes.add(
            Chunk(
                record.start,
                record.length,
                record.number(b"size"),
                record.fields[b"compression"].decode(),
            )
        )

    def _add_message(self, chunk: int, record: _Record) -> None:
        if record.op == _MESSAGE:
            s, ns = struct.unpack("<II", record.fields[b"time"])
            self._unindexed.setdefault(record.number(b"conn"), []).append(
                MessageRef(s * 1_000_000_000 + ns, chunk, record.begin)
            )

    def _add_connection(self, chunk: int, record: _Record) -> None:
        if record.op == _CONNECTION and record.length <= _MAX_HEADER_BYTES:
            its = _fields(self._bytes.read(chunk, record.start, record.length))
            package, _, name = its[b"type"].decode().partition("/")
            kind = f"{package}/msg/{name}"
            self._connections[record.number(b"conn")] = Topic(
                record.fields[b"topic"].decode(), kind, "ros1"
            )


def _fields(header: bytes) -> dict[bytes, bytes]:
    """The fields ``name=value`` of a header, each behind its length."""
    fields, position = {}, 0
    while position < len(header):
        (length,) = _U32.unpack_from(header, position)
        name, _, value = header[position + 4 : position + 4 + length].partition(b"=")
        fields[name] = value
        position += 4 + length
    return fields
