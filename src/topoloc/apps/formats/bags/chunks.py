"""Bytes of a chunked file: of the file itself, and of its chunks, unpacked when they are asked for
and no more of them kept than needed.

Sizes are what the file says of itself, so nothing is read or unpacked beyond them, whatever the
packed bytes say.
"""

from __future__ import annotations

import bz2
import os
import threading
import weakref
from collections import OrderedDict
from dataclasses import dataclass, field
from pathlib import Path

from topoloc.apps.formats.bags.message_file import CutShortError
from topoloc.errors import RecordingError

WHOLE_FILE = -1
MAX_CHUNK_BYTES = 1 << 29
_BEGINNING = 1 << 17
_KEPT_BYTES = 1 << 26  # of unpacked chunks; pictures of a pair lie in neighbouring ones


@dataclass(frozen=True)
class Chunk:
    """Where a chunk's bytes begin in the file, how many there are, how they are packed, and how
    many they are unpacked."""

    start: int
    num_packed: int
    num_bytes: int
    compression: str

    @property
    def is_packed(self) -> bool:
        return self.compression not in ("", "none")


@dataclass(eq=False)
class ChunkedBytes:
    """Random access to a file and to its chunks."""

    path: Path
    chunks: list[Chunk] = field(default_factory=list)
    size: int = 0
    _descriptor: int = -1
    _unpacked: OrderedDict[int, bytes] = field(default_factory=OrderedDict, repr=False)
    _num_kept: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def __post_init__(self) -> None:
        try:
            self._descriptor = os.open(self.path, os.O_RDONLY)
        except OSError as error:
            raise RecordingError(f"{self.path}: {error.strerror}") from None
        weakref.finalize(self, os.close, self._descriptor)
        self.size = os.fstat(self._descriptor).st_size

    def add(self, chunk: Chunk) -> None:
        """Adds a chunk; of one that was cut off, what is left and can be unpacked."""
        left = self.size - chunk.start
        if chunk.is_packed and chunk.num_packed > left:
            content = _unpacked(
                self.read(WHOLE_FILE, chunk.start, left),
                chunk.compression,
                min(chunk.num_bytes, MAX_CHUNK_BYTES),
            )
            chunk = Chunk(chunk.start, left, len(content), chunk.compression)
        self.chunks.append(chunk)

    def end_of(self, chunk: int) -> int:
        """How many bytes there are to read in a chunk, or in the file: of an open chunk that was
        cut off, those that are left."""
        if chunk == WHOLE_FILE:
            return self.size
        its = self.chunks[chunk]
        return its.num_bytes if its.is_packed else min(its.num_packed, self.size - its.start)

    def read(self, chunk: int, offset: int, length: int) -> bytes:
        """`length` bytes. Raises CutShortError where there are not so many."""
        if offset < 0 or length < 0 or offset + length > self.end_of(chunk):
            raise CutShortError
        if chunk != WHOLE_FILE and self.chunks[chunk].is_packed:
            return self._unpack(chunk, offset + length)[offset : offset + length]
        start = 0 if chunk == WHOLE_FILE else self.chunks[chunk].start
        try:
            data = os.pread(self._descriptor, length, start + offset)
        except OSError as error:
            raise RecordingError(f"{self.path}: {error.strerror}") from None
        if len(data) != length:  # shorter than when it was opened
            raise CutShortError
        return data

    def _unpack(self, chunk: int, end: int) -> bytes:
        """At least the first `end` bytes of a chunk. Where few are needed, as for a message's time,
        the others stay packed."""
        with self._lock:
            content = self._unpacked.pop(chunk, b"")
            self._num_kept -= len(content)
            if len(content) < end <= _BEGINNING:
                content = self._beginning(self.chunks[chunk])
            if len(content) < end:
                content = self._whole(self.chunks[chunk])
            self._unpacked[chunk] = content
            self._num_kept += len(content)
            while len(self._unpacked) > 1 and self._num_kept > _KEPT_BYTES:
                self._num_kept -= len(self._unpacked.popitem(last=False)[1])
            return content

    def _beginning(self, its: Chunk) -> bytes:
        packed = self.read(WHOLE_FILE, its.start, min(its.num_packed, 2 * _BEGINNING))
        return _unpacked(packed, its.compression, min(its.num_bytes, _BEGINNING))

    def _whole(self, its: Chunk) -> bytes:
        if its.num_bytes > MAX_CHUNK_BYTES:
            raise CutShortError
        content = _unpacked(
            self.read(WHOLE_FILE, its.start, its.num_packed), its.compression, its.num_bytes
        )
        if len(content) != its.num_bytes:
            raise CutShortError
        return content


def _unpacked(packed: bytes, compression: str, num_bytes: int) -> bytes:
    """Unpacked, at most `num_bytes`."""
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
        raise CutShortError from None
    raise RecordingError(
        f"chunks packed by {compression!r} cannot be read; known are lz4, zstd and bz2"
    )
