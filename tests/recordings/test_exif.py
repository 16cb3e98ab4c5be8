"""Test the focal length in EXIF data: both byte orders, both tags, and missing or damaged data."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from topoloc.recordings.exif import exif_focal_length
from topoloc.recordings.image_io import read_image

SHORT, LONG, RATIONAL = 3, 4, 5
FOCAL, FOCAL_35MM, WIDTH, RESOLUTION, UNIT = 0x920A, 0xA405, 0xA002, 0xA20E, 0xA210


def _exif(order: str, tags: dict[int, tuple[int, int, int]]) -> bytes:
    """Return a TIFF block with one directory that points to the EXIF directory. Each tag is (type,
    numerator, denominator)."""
    start, entries, values = 26, b"", b""
    after = start + 2 + 12 * len(tags) + 4
    for tag, (kind, numerator, denominator) in sorted(tags.items()):
        if kind == RATIONAL:
            entries += struct.pack(order + "HHII", tag, kind, 1, after + len(values))
            values += struct.pack(order + "II", numerator, denominator)
        elif kind == SHORT:
            entries += struct.pack(order + "HHIHH", tag, kind, 1, numerator, 0)
        else:
            entries += struct.pack(order + "HHII", tag, kind, 1, numerator)
    head = (b"II" if order == "<" else b"MM") + struct.pack(order + "HI", 42, 8)
    first = struct.pack(order + "HHHIII", 1, 0x8769, LONG, 1, start, 0)
    return (
        head
        + first
        + struct.pack(order + "H", len(tags))
        + entries
        + struct.pack(order + "I", 0)
        + values
    )


def _jpeg(path: Path, exif: bytes) -> Path:
    _, data = cv2.imencode(
        ".jpg", np.random.default_rng(0).integers(0, 256, (480, 640), dtype=np.uint8)
    )
    body = data.tobytes()
    segment = b"Exif\0\0" + exif
    path.write_bytes(
        body[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + body[2:]
    )
    return path


@pytest.mark.parametrize("order", ["<", ">"])
def test_the_equivalent_on_film_is_taken_by_the_diagonal(order: str, tmp_path: Path):
    picture = _jpeg(
        tmp_path / "a.jpg", _exif(order, {FOCAL: (RATIONAL, 425, 100), FOCAL_35MM: (SHORT, 26, 1)})
    )
    assert read_image(picture).shape == (480, 640)
    assert exif_focal_length(picture, 640, 480) == pytest.approx(26 / 43.2666 * 800, rel=1e-4)


@pytest.mark.parametrize(("unit", "resolution"), [(2, 2540), (3, 1000), (4, 100)])
def test_millimetres_are_taken_by_the_sensors_resolution(
    unit: int, resolution: int, tmp_path: Path
):
    tags = {
        FOCAL: (RATIONAL, 50, 10),
        RESOLUTION: (RATIONAL, resolution, 1),
        UNIT: (SHORT, unit, 1),
        WIDTH: (LONG, 1280, 1),
    }
    # 5 mm at 100 pixels per millimetre, and the image has half of its original width
    assert exif_focal_length(
        _jpeg(tmp_path / "a.jpg", _exif("<", tags)), 640, 480
    ) == pytest.approx(250.0)


@pytest.mark.parametrize(
    "exif",
    [
        _exif("<", {}),
        _exif("<", {FOCAL: (RATIONAL, 5, 0)}),
        _exif("<", {FOCAL: (RATIONAL, 5, 1)}),
        _exif("<", {FOCAL_35MM: (SHORT, 0, 1)}),
        _exif(">", {FOCAL_35MM: (SHORT, 60000, 1)}),
        _exif("<", {FOCAL: (RATIONAL, 50, 10)})[:30],
        b"II*\0\xff\xff\xff\xff",
        b"XX",
    ],
    ids=[
        "no tags",
        "over zero",
        "no resolution",
        "zero",
        "beyond sense",
        "cut off",
        "points nowhere",
        "no order",
    ],
)
def test_data_without_a_focal_length_gives_none(exif: bytes, tmp_path: Path):
    assert exif_focal_length(_jpeg(tmp_path / "a.jpg", exif), 640, 480) is None


def test_other_files_give_none(tmp_path: Path):
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    assert exif_focal_length(tmp_path / "a.png", 640, 480) is None
    assert exif_focal_length(tmp_path / "missing.jpg", 640, 480) is None
