"""The focal length that a camera wrote into a JPEG file: EXIF 2.32 (JEITA CP-3451), the few tags that tell of it.

Nothing but numbers is read, and nothing is believed that makes no sense: a file without them, or with damaged ones, has none.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path

_JPEG_START, _APP1, _SCAN = b"\xff\xd8", 0xE1, 0xDA
_EXIF_IFD = 0x8769
_FOCAL_LENGTH, _FOCAL_LENGTH_35MM = 0x920A, 0xA405
_PIXEL_WIDTH, _PLANE_RESOLUTION, _PLANE_UNIT = 0xA002, 0xA20E, 0xA210
_MM_OF_UNIT = {2: 25.4, 3: 10.0, 4: 1.0}  # inch, centimetre, millimetre
_DIAGONAL_35MM = math.hypot(36.0, 24.0)
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 7: 1, 9: 4, 10: 8}
_MAX_HEADER_BYTES = 1 << 20


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
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != _SCAN:
        (length,) = struct.unpack_from(">H", data, at + 2)
        if data[at + 1] == _APP1 and data[at + 4 : at + 10] == b"Exif\0\0":
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
