"""Read files of records in chunks: the part that MCAP files and ROS 1 bags have in common.

Opening reads the headers of records and skips their content, because messages of images make up
most of a file. The readers of rosbags and mcap need the index at the end of a file, or read all of
it. Without this index, or if the file is cut off, the indexes behind the chunks are used. A chunk
without an index (the last one of such a file) is read itself. Chunks are decompressed when they are
needed. Nothing is read or decompressed beyond the sizes that the file gives.
"""

from __future__ import annotations

import bz2
import os
import struct
import threading
import weakref
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from topoloc import RecordingError
from topoloc.apps.formats.bags.bag import (
    MessageRef,
    Topic,
    TruncatedFileError,
    damaged_message_error,
)

WHOLE_FILE = -1
MAX_CHUNK_BYTES = 1 << 29
_PREFIX_BYTES = 1 << 17
_MAX_CACHE_BYTES = 1 << 26  # of unpacked chunks; pictures of a pair lie in neighbouring ones


@dataclass(frozen=True)
class Chunk:
    """Hold the position of a chunk in the file, its compressed size, its compression and its size
    in bytes."""

    start: int
    num_compressed_bytes: int
    num_bytes: int
    compression: str

    @property
    def is_compressed(self) -> bool:
        return self.compression not in ("", "none")


@dataclass(eq=False)
class ChunkedBytes:
    """Read from any position of a file and its chunks."""

    path: Path
    chunks: list[Chunk] = field(default_factory=list)
    size: int = 0
    _descriptor: int = -1
    _decompressed: OrderedDict[int, bytes] = field(default_factory=OrderedDict, repr=False)
    _num_cached_bytes: int = 0
    _lock: Any = field(default_factory=threading.RLock, repr=False)

    def __post_init__(self) -> None:
        with RecordingError.at(self.path, OSError):
            self._descriptor = os.open(self.path, os.O_RDONLY | getattr(os, "O_BINARY", 0))
        weakref.finalize(self, os.close, self._descriptor)
        self.size = os.fstat(self._descriptor).st_size

    def add(self, chunk: Chunk) -> None:
        """Add a chunk. Of one that is cut off, the part that can be decompressed is added."""
        left = self.size - chunk.start
        if chunk.is_compressed and chunk.num_compressed_bytes > left:
            packed, most = self.read(WHOLE_FILE, chunk.start, left), chunk.num_bytes
            content = _decompressed(packed, chunk.compression, min(most, MAX_CHUNK_BYTES))
            chunk = Chunk(chunk.start, left, len(content), chunk.compression)
        self.chunks.append(chunk)

    def readable_size(self, chunk: int) -> int:
        """Return the number of bytes of a chunk, or of the file. Of an uncompressed chunk that is
        cut off, the bytes that are left count."""
        if chunk == WHOLE_FILE:
            return self.size
        its = self.chunks[chunk]
        left = min(its.num_compressed_bytes, self.size - its.start)
        return its.num_bytes if its.is_compressed else left

    def read(self, chunk: int, offset: int, length: int) -> bytes:
        """Return `length` bytes. Raises TruncatedFileError if the file has fewer."""
        if offset < 0 or length < 0 or offset + length > self.readable_size(chunk):
            raise TruncatedFileError
        if chunk != WHOLE_FILE and self.chunks[chunk].is_compressed:
            return self._read_decompressed(chunk, offset + length)[offset : offset + length]
        start = 0 if chunk == WHOLE_FILE else self.chunks[chunk].start
        with RecordingError.at(self.path, OSError):
            data = self._read_at(length, start + offset)
        if len(data) != length:  # shorter than when it was opened
            raise TruncatedFileError
        return data

    def _read_at(self, length: int, position: int) -> bytes:
        if hasattr(os, "pread"):
            return os.pread(self._descriptor, length, position)
        with self._lock:  # Windows
            os.lseek(self._descriptor, position, os.SEEK_SET)
            return os.read(self._descriptor, length)

    def _read_decompressed(self, chunk: int, end: int) -> bytes:
        """Return at least the first `end` bytes of a chunk. If few are needed, such as the time of
        a message, the rest is not decompressed."""
        with self._lock:
            content = self._decompressed.pop(chunk, b"")
            self._num_cached_bytes -= len(content)
            if len(content) < end <= _PREFIX_BYTES:
                content = self._decompress_prefix(self.chunks[chunk])
            if len(content) < end:
                content = self._decompress_chunk(self.chunks[chunk])
            self._decompressed[chunk] = content
            self._num_cached_bytes += len(content)
            while len(self._decompressed) > 1 and self._num_cached_bytes > _MAX_CACHE_BYTES:
                self._num_cached_bytes -= len(self._decompressed.popitem(last=False)[1])
            return content

    def _decompress_prefix(self, its: Chunk) -> bytes:
        packed = self.read(WHOLE_FILE, its.start, min(its.num_compressed_bytes, 2 * _PREFIX_BYTES))
        return _decompressed(packed, its.compression, min(its.num_bytes, _PREFIX_BYTES))

    def _decompress_chunk(self, its: Chunk) -> bytes:
        if its.num_bytes > MAX_CHUNK_BYTES:
            raise TruncatedFileError
        packed = self.read(WHOLE_FILE, its.start, its.num_compressed_bytes)
        content = _decompressed(packed, its.compression, its.num_bytes)
        if len(content) != its.num_bytes:
            raise TruncatedFileError
        return content


def _decompressed(packed: bytes, compression: str, num_bytes: int) -> bytes:
    """Return the decompressed bytes, at most `num_bytes`."""
    import lz4.frame
    import zstandard

    try:
        if compression == "zstd":
            return zstandard.ZstdDecompressor().stream_reader(packed).read(num_bytes)
        if compression == "lz4":
            return lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=num_bytes)
        if compression == "bz2":
            return bz2.BZ2Decompressor().decompress(packed, max_length=num_bytes)
    except (zstandard.ZstdError, RuntimeError, OSError, ValueError, EOFError):
        raise TruncatedFileError from None
    raise RecordingError(
        f"chunks packed by {compression!r} cannot be read; known are lz4, zstd and bz2"
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
