"""Read the records of MCAP files (mcap.dev/spec)."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from topoloc.apps.formats.bags.bag import MessageRef, Topic, TruncatedFileError
from topoloc.apps.formats.bags.chunked_file import WHOLE_FILE, Chunk, ChunkedFile, Record

_RECORD, _MESSAGE, _CHUNK = struct.Struct("<BQ"), struct.Struct("<HIQQ"), struct.Struct("<QQQI")
_INDEX_ENTRY = np.dtype([("t_ns", "<u8"), ("offset", "<u8")])
_MAX_DEFINITION_BYTES = 1 << 24
_MAX_TIME_NS = (1 << 63) - 1


@dataclass(eq=False)
class McapFile(ChunkedFile):
    """An MCAP file."""

    magic = b"\x89MCAP0\r\n"
    message_op, index_op, chunk_op = Opcode.MESSAGE, Opcode.MESSAGE_INDEX, Opcode.CHUNK
    damage_errors = (McapError, *ChunkedFile.damage_errors)

    _schemas: dict[int, Schema] = field(default_factory=dict)

    def _iterate_records(self, chunk: int, position: int) -> Iterator[Record]:
        end = self._bytes.readable_size(chunk)
        while position < end:
            op, length = _RECORD.unpack(self._bytes.read(chunk, position, _RECORD.size))
            start = position + _RECORD.size
            if start + length > end and op != Opcode.CHUNK:
                raise TruncatedFileError
            yield Record(op, position, start, length, {})
            if op == Opcode.FOOTER:
                return
            position = start + length
        raise TruncatedFileError

    def _find_message(self, ref: MessageRef) -> Record:
        record, size = next(self._iterate_records(ref.chunk, ref.offset)), _MESSAGE.size
        return record._replace(start=record.start + size, length=record.length - size)

    def _parse_chunk(self, record: Record) -> Chunk:
        header = self._bytes.read(WHOLE_FILE, record.start, min(record.length, 64))
        *_, num_bytes, _ = _CHUNK.unpack_from(header)
        (name_length,) = struct.unpack_from("<I", header, _CHUNK.size)
        after = _CHUNK.size + 4 + name_length
        (num_compressed_bytes,) = struct.unpack_from("<Q", header, after)
        compression = header[_CHUNK.size + 4 : after].decode()
        if after + 8 + num_compressed_bytes > record.length:
            raise TruncatedFileError
        return Chunk(record.start + after + 8, num_compressed_bytes, num_bytes, compression)

    def _parse_index_header(self, record: Record) -> tuple[int, int, int]:
        number, size = struct.unpack("<HI", self._bytes.read(WHOLE_FILE, record.start, 6))
        size = max(min(size, record.length - 6), 0)
        return number, record.start + 6, size // _INDEX_ENTRY.itemsize * _INDEX_ENTRY.itemsize

    def _parse_index(self, data: bytes) -> list[tuple[int, int]]:
        entries = np.frombuffer(data, _INDEX_ENTRY).tolist()
        return [(min(t_ns, _MAX_TIME_NS), offset) for t_ns, offset in entries]

    def _parse_message_header(self, chunk: int, record: Record) -> tuple[int, int]:
        header = self._bytes.read(chunk, record.start, _MESSAGE.size)
        number, _, t_ns, _ = _MESSAGE.unpack(header)
        return number, min(t_ns, _MAX_TIME_NS)

    def _add_definition(self, chunk: int, record: Record) -> None:
        is_definition = record.op in (Opcode.SCHEMA, Opcode.CHANNEL)
        if not is_definition or record.length > _MAX_DEFINITION_BYTES:
            return
        data = self._bytes.read(chunk, record.start, record.length)
        stream = ReadDataStream(io.BytesIO(data))
        if record.op == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self._schemas[schema.id] = schema
            return
        channel = Channel.read(stream)
        schema = self._schemas.get(channel.schema_id, Schema(0, b"", "", ""))
        kind, encoding = _ros_type(schema.name), channel.message_encoding
        self._channels[channel.id] = Topic(channel.topic, kind, encoding, schema.data)


def _ros_type(name: str) -> str:
    """Return ``sensor_msgs/msg/Image`` for ``sensor_msgs/Image``, the form of ROS 1."""
    package, slash, rest = name.partition("/")
    return f"{package}/msg/{rest}" if slash and "/" not in rest else name
