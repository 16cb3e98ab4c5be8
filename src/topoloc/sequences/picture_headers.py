"""What the bytes of a picture file say before they are decoded: its size, and whether it is all there.

PNG (ISO/IEC 15948, sections 5.2-5.6), JPEG (ITU-T T.81, annex B), BMP and binary PNM are read; TIFF and WebP are known
by their first bytes and left to the decoder. Of a camera's own words (EXIF 2.32, JEITA CP-3451) the few that tell the focal length are
read; nothing is believed that makes no sense.
"""

from __future__ import annotations

import math
import re
import struct
import zlib
from pathlib import Path

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_PNM = re.compile(rb"P([56])(?:\s+|#[^\n]*\n)+(\d+)(?:\s+|#[^\n]*\n)+(\d+)(?:\s+|#[^\n]*\n)+(\d+)\s")
# Start-of-frame markers; C4, C8 and CC in the same range are tables.
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_SCAN, _JPEG_APP1 = 0xDA, 0xE1
_EXIF_IFD = 0x8769
_FOCAL_LENGTH, _FOCAL_LENGTH_35MM = 0x920A, 0xA405
_PIXEL_WIDTH, _PLANE_RESOLUTION, _PLANE_UNIT = 0xA002, 0xA20E, 0xA210
_MM_OF_UNIT = {2: 25.4, 3: 10.0, 4: 1.0}  # inch, centimetre, millimetre
_DIAGONAL_35MM = math.hypot(36.0, 24.0)
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 7: 1, 9: 4, 10: 8}
_MAX_HEADER_BYTES = 1 << 20


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


def exif_focal_length(path: Path, width: int, height: int) -> float | None:
    """Focal length in pixels of a picture of this size, by its EXIF data; None where the file says nothing usable.

    The focal length equivalent on 35 mm film counts first (its diagonal stands for the picture's), then the one in millimetres with the
    resolution of the sensor.
    """
    try:
        with path.open("rb") as file:
            tags = _read_tags(file.read(_MAX_HEADER_BYTES))
    except (OSError, struct.error, IndexError):
        return None
    focal = tags.get(_FOCAL_LENGTH_35MM, 0.0) * math.hypot(width, height) / _DIAGONAL_35MM
    if not focal > 0.0:
        mm_a_unit = _MM_OF_UNIT.get(int(tags.get(_PLANE_UNIT, 2.0)), 25.4)
        scale = width / tags[_PIXEL_WIDTH] if tags.get(_PIXEL_WIDTH, 0.0) > 0.0 else 1.0
        focal = tags.get(_FOCAL_LENGTH, 0.0) * tags.get(_PLANE_RESOLUTION, 0.0) / mm_a_unit * scale
    side = max(width, height)
    return focal if 0.1 * side < focal < 50.0 * side else None


def _read_tags(data: bytes) -> dict[int, float]:
    """The first number of each tag of the EXIF block; nothing where there is none."""
    if not data.startswith(_JPEG_START):
        return {}
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != _JPEG_SCAN:
        (length,) = struct.unpack_from(">H", data, at + 2)
        if data[at + 1] == _JPEG_APP1 and data[at + 4 : at + 10] == b"Exif\0\0":
            return _read_tiff(data[at + 10 : at + 2 + length])
        at += 2 + max(length, 2)
    return {}


def _read_tiff(tiff: bytes) -> dict[int, float]:
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None:
        return {}
    (first,) = struct.unpack_from(order + "I", tiff, 4)
    tags = _read_directory(tiff, order, first)
    if _EXIF_IFD in tags:
        tags |= _read_directory(tiff, order, int(tags[_EXIF_IFD]))
    return tags


def _read_directory(tiff: bytes, order: str, at: int) -> dict[int, float]:
    (num_entries,) = struct.unpack_from(order + "H", tiff, at)
    tags: dict[int, float] = {}
    for entry in range(at + 2, at + 2 + 12 * num_entries, 12):
        tag, kind, count = struct.unpack_from(order + "HHI", tiff, entry)
        if kind not in (3, 4, 5) or count < 1:
            continue
        is_inside = _SIZES[kind] * count <= 4
        where = entry + 8 if is_inside else struct.unpack_from(order + "I", tiff, entry + 8)[0]
        if kind == 5:
            numerator, denominator = struct.unpack_from(order + "II", tiff, where)
            tags[tag] = numerator / denominator if denominator else 0.0
        else:
            tags[tag] = float(struct.unpack_from(order + ("H" if kind == 3 else "I"), tiff, where)[0])
    return tags
