"""Read the records of ROS 1 bags (format 2.0, wiki.ros.org/Bags/Format/2.0)."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from topoloc.apps.formats.bags.bag import MessageRef, Topic, TruncatedFileError
from topoloc.apps.formats.bags.chunked_file import Chunk, ChunkedFile, Record

_BAG, _CONNECTION = 3, 7
_MAX_HEADER_BYTES = 1 << 20
_U32 = struct.Struct("<I")
_INDEX_ENTRY = np.dtype([("s", "<u4"), ("ns", "<u4"), ("offset", "<u4")])


@dataclass(eq=False)
class Ros1File(ChunkedFile):
    """A ROS 1 bag, also one that was never closed (``.bag.active``)."""

    magic = b"#ROSBAG V2.0\n"
    message_op, index_op, chunk_op = 2, 4, 5

    _is_closed: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self._is_closed:
            self.fault = self.fault or "never closed by its recorder"

    def _iterate_records(self, chunk: int, position: int) -> Iterator[Record]:
        end = self._bytes.readable_size(chunk)
        while position < end:
            begin = position
            (length,) = _U32.unpack(self._bytes.read(chunk, begin, 4))
            if length > _MAX_HEADER_BYTES:
                raise TruncatedFileError
            header = self._bytes.read(chunk, begin + 4, length + 4)
            fields = _parse_fields(header[:-4])
            op, start, length = fields[b"op"][0], begin + length + 8, _U32.unpack(header[-4:])[0]
            position = start + length
            if position > end and op != self.chunk_op:
                raise TruncatedFileError
            yield Record(op, begin, start, length, fields)
        if position > end:
            raise TruncatedFileError

    def _find_message(self, ref: MessageRef) -> Record:
        records = self._iterate_records(ref.chunk, ref.offset)
        return next(record for record in records if record.op != _CONNECTION)

    def _parse_chunk(self, record: Record) -> Chunk:
        compression = record.fields[b"compression"].decode()
        return Chunk(record.start, record.length, _number(record, b"size"), compression)

    def _parse_index_header(self, record: Record) -> tuple[int, int, int]:
        size = record.length // _INDEX_ENTRY.itemsize * _INDEX_ENTRY.itemsize
        return _number(record, b"conn"), record.start, size

    def _parse_index(self, data: bytes) -> list[tuple[int, int]]:
        entries = np.frombuffer(data, _INDEX_ENTRY).tolist()
        return [(s * 1_000_000_000 + ns, offset) for s, ns, offset in entries]

    def _parse_message_header(self, chunk: int, record: Record) -> tuple[int, int]:
        s, ns = struct.unpack("<II", record.fields[b"time"])
        return _number(record, b"conn"), s * 1_000_000_000 + ns

    def _add_definition(self, chunk: int, record: Record) -> None:
        if record.op == _BAG:
            self._is_closed = any(record.fields[b"index_pos"])
        elif record.op == _CONNECTION and record.length <= _MAX_HEADER_BYTES:
            its = _parse_fields(self._bytes.read(chunk, record.start, record.length))
            package, _, name = its[b"type"].decode().partition("/")
            self._channels[_number(record, b"conn")] = Topic(
                record.fields[b"topic"].decode(), f"{package}/msg/{name}", "ros1"
            )


def _number(record: Record, name: bytes) -> int:
    return _U32.unpack(record.fields[name])[0]


def _parse_fields(header: bytes) -> dict[bytes, bytes]:
    """Return the fields ``name=value`` of a header. Each has its length before it."""
    fields, position = {}, 0
    while position < len(header):
        (length,) = _U32.unpack_from(header, position)
        name, _, value = header[position + 4 : position + 4 + length].partition(b"=")
        fields[name] = value
        position += 4 + length
    return fields
