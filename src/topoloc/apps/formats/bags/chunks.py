"""Read bytes of a file and of its chunks, which are decompressed when they are needed.

The sizes are stored in the file. Nothing is read or decompressed beyond them.
"""

from __future__ import annotations

import bz2
import os
import threading
import weakref
from collections import OrderedDict
from dataclasses import dataclass, field
from pathlib import Path

from topoloc import RecordingError
from topoloc.apps.formats.bags.message_file import TruncatedFileError

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
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def __post_init__(self) -> None:
        try:
            self._descriptor = os.open(self.path, os.O_RDONLY)
        except OSError as error:
            raise RecordingError(f"{self.path}: {error.strerror}") from None
        weakref.finalize(self, os.close, self._descriptor)
        self.size = os.fstat(self._descriptor).st_size

    def add(self, chunk: Chunk) -> None:
        """Add a chunk. Of one that is cut off, the part that can be decompressed is added."""
        left = self.size - chunk.start
        if chunk.is_compressed and chunk.num_compressed_bytes > left:
            content = _decompressed(
                self.read(WHOLE_FILE, chunk.start, left),
                chunk.compression,
                min(chunk.num_bytes, MAX_CHUNK_BYTES),
            )
            chunk = Chunk(chunk.start, left, len(content), chunk.compression)
        self.chunks.append(chunk)

    def readable_size(self, chunk: int) -> int:
        """Return the number of bytes of a chunk, or of the file. Of an uncompressed chunk that is
        cut off, the bytes that are left count."""
        if chunk == WHOLE_FILE:
            return self.size
        its = self.chunks[chunk]
        return (
            its.num_bytes
            if its.is_compressed
            else min(its.num_compressed_bytes, self.size - its.start)
        )

    def read(self, chunk: int, offset: int, length: int) -> bytes:
        """Return `length` bytes. Raises TruncatedFileError if the file has fewer."""
        if offset < 0 or length < 0 or offset + length > self.readable_size(chunk):
            raise TruncatedFileError
        if chunk != WHOLE_FILE and self.chunks[chunk].is_compressed:
            return self._read_decompressed(chunk, offset + length)[offset : offset + length]
        start = 0 if chunk == WHOLE_FILE else self.chunks[chunk].start
        try:
            data = os.pread(self._descriptor, length, start + offset)
        except OSError as error:
            raise RecordingError(f"{self.path}: {error.strerror}") from None
        if len(data) != length:  # shorter than when it was opened
            raise TruncatedFileError
        return data

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
        content = _decompressed(
            self.read(WHOLE_FILE, its.start, its.num_compressed_bytes),
            its.compression,
            its.num_bytes,
        )
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
