"""MCAP files (mcap.dev/spec), gone through record by record without their messages, so that one
that was cut off is read as any other.

What a chunk holds is said by the index behind it; a chunk without one (the last of a file that was
cut off) is gone through itself.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from topoloc.apps.formats.bags.chunks import WHOLE_FILE, Chunk, ChunkedBytes
from topoloc.apps.formats.bags.message_file import (
    MessageRef,
    Topic,
    TruncatedFileError,
    damaged_message_error,
)

MAGIC = b"\x89MCAP0\r\n"
_RECORD, _MESSAGE, _CHUNK = struct.Struct("<BQ"), struct.Struct("<HIQQ"), struct.Struct("<QQQI")
_INDEX_ENTRY = np.dtype([("t_ns", "<u8"), ("offset", "<u8")])
_MAX_DEFINITION_BYTES = 1 << 24
_MAX_TIME_NS = (1 << 63) - 1
_DAMAGE_ERRORS = (McapError, struct.error, UnicodeDecodeError, EOFError)


@dataclass(eq=False)
class McapFile:
    """An MCAP file, by what its records say of where things are."""

    path: Path
    topics: dict[str, Topic] = field(default_factory=dict)
    fault: str | None = None
    _bytes: ChunkedBytes = field(init=False)
    _schemas: dict[int, Schema] = field(default_factory=dict)
    _channels: dict[int, Channel] = field(default_factory=dict)
    # Of each channel: (chunk, where its index lies, its length in bytes), and messages that no
    # index names.
    _indexes: dict[int, list[tuple[int, int, int]]] = field(default_factory=dict)
    _unindexed: dict[int, list[MessageRef]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._bytes = ChunkedBytes(self.path)
        indexed = self._scan()
        for chunk in range(len(self._bytes.chunks)):
            if chunk not in indexed:
                self._scan_chunk(chunk, self._add_message)
        self._find_channels()
        for channel in self._channels.values():
            schema = self._schemas.get(channel.schema_id)
            name = _ros_type(schema.name) if schema is not None else ""
            data = schema.data if schema is not None else b""
            self.topics.setdefault(
                channel.topic, Topic(channel.topic, name, channel.message_encoding, data)
            )

    def messages(self, topic: str) -> list[MessageRef]:
        """The messages of a topic, in the order in which they were written."""
        refs: list[MessageRef] = []
        for number in (
            number for number, channel in self._channels.items() if channel.topic == topic
        ):
            refs += self._unindexed.get(number, [])
            for chunk, start, length in self._indexes.get(number, []):
                entries = np.frombuffer(self._bytes.read(WHOLE_FILE, start, length), _INDEX_ENTRY)
                refs += [
                    MessageRef(min(t_ns, _MAX_TIME_NS), chunk, offset)
                    for t_ns, offset in entries.tolist()
                ]
        return sorted(refs)

    def read(self, ref: MessageRef, most: int | None = None) -> bytes:
        """The bytes of a message, or the first `most` of them. Raises RecordingError."""
        try:
            opcode, length = self._read_record_header(ref.chunk, ref.offset)
            if opcode != Opcode.MESSAGE or length < _MESSAGE.size:
                raise TruncatedFileError
            length -= _MESSAGE.size
            start = ref.offset + _RECORD.size + _MESSAGE.size
            return self._bytes.read(ref.chunk, start, length if most is None else min(length, most))
        except TruncatedFileError:
            raise damaged_message_error(self.path.name, ref) from None

    def _read_record_header(self, chunk: int, offset: int) -> tuple[int, int]:
        return _RECORD.unpack(self._bytes.read(chunk, offset, _RECORD.size))

    def _iterate_records(self, chunk: int) -> Iterator[tuple[int, int, int]]:
        """(opcode, where its content begins, its length) of each record that is whole."""
        position, end = len(MAGIC) if chunk == WHOLE_FILE else 0, self._bytes.readable_size(chunk)
        while position < end:
            opcode, length = self._read_record_header(chunk, position)
            position += _RECORD.size
            if position + length > end and opcode != Opcode.CHUNK:
                raise TruncatedFileError
            yield opcode, position, length
            position += length
            if opcode == Opcode.FOOTER:
                return
        raise TruncatedFileError

    def _scan(self) -> set[int]:
        """Notes what the records of the file say; the chunks that have an index."""
        indexed: set[int] = set()
        position = 0
        try:
            for opcode, position, length in self._iterate_records(WHOLE_FILE):
                if opcode == Opcode.CHUNK:
                    self._add_chunk(position, length)
                elif opcode == Opcode.MESSAGE_INDEX and self._bytes.chunks:
                    channel, size = struct.unpack("<HI", self._bytes.read(WHOLE_FILE, position, 6))
                    size = (
                        max(min(size, length - 6), 0)
                        // _INDEX_ENTRY.itemsize
                        * _INDEX_ENTRY.itemsize
                    )
                    self._indexes.setdefault(channel, []).append(
                        (len(self._bytes.chunks) - 1, position + 6, size)
                    )
                    indexed.add(len(self._bytes.chunks) - 1)
                elif opcode == Opcode.MESSAGE:
                    self._add_message(WHOLE_FILE, opcode, position, length)
                else:
                    self._add_definition(WHOLE_FILE, opcode, position, length)
        except (TruncatedFileError, *_DAMAGE_ERRORS):
            self.fault = f"cut off or damaged after {position / 1e6:.3f} MB"
        return indexed

    def _scan_chunk(self, chunk: int, *handlers) -> None:
        """Goes through the records of one chunk, as far as it is whole."""
        try:
            for record in self._iterate_records(chunk):
                for handler in handlers:
                    handler(chunk, *record)
        except (TruncatedFileError, *_DAMAGE_ERRORS):
            return

    def _find_channels(self) -> None:
        """Channels that are described within chunks alone, as in a file whose summary is
        missing."""
        for number in [*self._indexes, *self._unindexed]:
            if number not in self._channels:
                chunk = (
                    self._indexes[number][0][0]
                    if number in self._indexes
                    else self._unindexed[number][0].chunk
                )
                self._scan_chunk(chunk, self._add_definition)

    def _add_chunk(self, position: int, length: int) -> None:
        header = self._bytes.read(WHOLE_FILE, position, min(length, 64))
        *_, num_bytes, _ = _CHUNK.unpack_from(header)
        (name_length,) = struct.unpack_from("<I", header, _CHUNK.size)
        after = _CHUNK.size + 4 + name_length
        (num_compressed_bytes,) = struct.unpack_from("<Q", header, after)
        compression = header[_CHUNK.size + 4 : after].decode()
        if after + 8 + num_compressed_bytes > length:
            raise TruncatedFileError
        self._bytes.add(Chunk(position + after + 8, num_compressed_bytes, num_bytes, compression))

    def _add_message(self, chunk: int, opcode: int, position: int, length: int) -> None:
        if opcode == Opcode.MESSAGE and length >= _MESSAGE.size:
            channel, _, log_t_ns, _ = _MESSAGE.unpack(
                self._bytes.read(chunk, position, _MESSAGE.size)
            )
            self._unindexed.setdefault(channel, []).append(
                MessageRef(min(log_t_ns, _MAX_TIME_NS), chunk, position - _RECORD.size)
            )

    def _add_definition(self, chunk: int, opcode: int, position: int, length: int) -> None:
        if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL) or length > _MAX_DEFINITION_BYTES:
            return
        stream = ReadDataStream(io.BytesIO(self._bytes.read(chunk, position, length)))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self._schemas[schema.id] = schema
        else:
            channel = Channel.read(stream)
            self._channels[channel.id] = channel


def _ros_type(name: str) -> str:
    """``sensor_msgs/Image``, as ROS 1 has it, becomes ``sensor_msgs/msg/Image``."""
    package, slash, rest = name.partition("/")
    return f"{package}/msg/{rest}" if slash and "/" not in rest else name
