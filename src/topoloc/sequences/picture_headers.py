"""What the bytes of a picture file say before they are decoded: its size, and whether it is all there.

PNG (ISO/IEC 15948, sections 5.2-5.6), JPEG (ITU-T T.81, annex B), BMP and binary PNM are read; TIFF and WebP are known
by their first bytes and left to the decoder.
"""

from __future__ import annotations

import re
import struct
import zlib

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_PNM = re.compile(rb"P([56])(?:\s+|#[^\n]*\n)+(\d+)(?:\s+|#[^\n]*\n)+(\d+)(?:\s+|#[^\n]*\n)+(\d+)\s")
# Start-of-frame markers; C4, C8 and CC in the same range are tables.
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_SCAN = 0xDA


class BrokenPicture(Exception):
    """The bytes are of a known type but truncated or damaged; the text says how. Becomes an UnreadableImageError."""


def header_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in pixels of a complete PNG, JPEG, BMP or binary PNM file; None for TIFF and WebP.

    Raises:
        BrokenPicture: the file is truncated, its checksums do not hold, or it is of none of these types.
    """
    if data.startswith(_PNG_SIGNATURE):
        return _png_size(data)
    if data.startswith(_JPEG_START):
        return _jpeg_size(data)
    if data.startswith(b"BM") and len(data) >= 26:
        return _bmp_size(data)
    if header := _PNM.match(data):
        return _pnm_size(data, header)
    if data.startswith((b"II*\0", b"MM\0*")) or (data.startswith(b"RIFF") and data[8:12] == b"WEBP"):
        return None
    raise BrokenPicture("not a picture, or not of a known type (PNG, JPEG, BMP, PNM, TIFF, WebP)")


def _png_size(data: bytes) -> tuple[int, int]:
    view = memoryview(data)
    size: tuple[int, int] | None = None
    at = len(_PNG_SIGNATURE)
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        kind = data[at + 4 : at + 8]
        end = at + 8 + length
        if end + 4 > len(data):
            break
        if zlib.crc32(view[at + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            raise BrokenPicture(f"damaged PNG file (checksum of {kind.decode('ascii', 'replace')})")
        if kind == b"IHDR" and length >= 8:
            size = struct.unpack_from(">II", data, at + 8)
        if kind == b"IEND" and size is not None:
            return size
        at = end + 4
    raise BrokenPicture("truncated PNG file")


def _jpeg_size(data: bytes) -> tuple[int, int]:
    size: tuple[int, int] | None = None
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        kind = data[at + 1]
        if kind == 0xFF:  # fill byte before a marker
            at += 1
            continue
        (length,) = struct.unpack_from(">H", data, at + 2)
        if kind in _JPEG_FRAMES and at + 9 <= len(data):
            height, width = struct.unpack_from(">HH", data, at + 5)
            size = (width, height)
        at += 2 + length
        if kind == _JPEG_SCAN:
            # In coded data FF is always followed by 00 or a restart marker, so the end marker is found only where it ends;
            # the search starts at the scan because the thumbnail in the header has an end marker of its own.
            if size is not None and data.find(_JPEG_END, at) >= 0:
                return size
            break
    raise BrokenPicture("truncated JPEG file")


def _bmp_size(data: bytes) -> tuple[int, int]:
    (file_size,) = struct.unpack_from("<I", data, 2)
    width, height = struct.unpack_from("<ii", data, 18)
    if file_size > len(data):
        raise BrokenPicture("truncated BMP file")
    return abs(width), abs(height)


def _pnm_size(data: bytes, header: re.Match[bytes]) -> tuple[int, int]:
    kind, width, height = header[1], int(header[2]), int(header[3])
    num_channels, num_bytes_each = (3 if kind == b"6" else 1), (2 if int(header[4]) > 255 else 1)
    num_bytes = width * height * num_channels * num_bytes_each
    if len(data) - header.end() < num_bytes:
        raise BrokenPicture("truncated PNM file")
    return width, height
