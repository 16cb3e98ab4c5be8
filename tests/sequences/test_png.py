"""The usual PNG decoded here, as Pillow decodes it; the unusual one left to Pillow."""

from __future__ import annotations

import io
import struct
import zlib

import numpy as np
import pytest
from PIL import Image, PngImagePlugin

from topoloc.sequences.pictures import PictureBytes, read_image
from topoloc.sequences.png import png_pixels

SHAPES = [((7, 5), np.uint8), ((6, 9, 3), np.uint8), ((1, 1), np.uint8), ((8, 11), np.uint16)]


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(pixels: np.ndarray, kinds: list[int], extra: bytes = b"") -> bytes:
    """A PNG whose rows are filtered in these ways by turns, whatever the bytes come to."""
    height, width = pixels.shape[:2]
    rows = np.random.default_rng(len(kinds)).integers(0, 256, (height, pixels[0].nbytes), np.uint8)
    filtered = b"".join(bytes([kinds[y % len(kinds)]]) + row.tobytes() for y, row in enumerate(rows))
    header = struct.pack(">IIBBBBB", width, height, 8 * pixels.itemsize, 2 if pixels.ndim == 3 else 0, 0, 0, 0)
    data = zlib.compress(filtered)
    parts = [chunk(b"IHDR", header), extra, chunk(b"IDAT", data[:9]), chunk(b"IDAT", data[9:]), chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


@pytest.mark.parametrize(("shape", "dtype"), SHAPES)
@pytest.mark.parametrize("kinds", [[0], [1], [2], [3], [4], [4, 3, 2, 1, 0]])
def test_all_filters_are_undone_as_pillow_undoes_them(shape: tuple[int, ...], dtype: type, kinds: list[int]):
    data = png(np.zeros(shape, dtype), kinds)
    pixels = png_pixels(data)
    assert pixels is not None
    assert pixels.dtype == dtype
    np.testing.assert_array_equal(pixels, np.array(Image.open(io.BytesIO(data))))


@pytest.mark.parametrize("text", [None, "Orientation"])
def test_what_may_say_more_is_left_to_pillow(text: str | None):
    buffer, info = io.BytesIO(), PngImagePlugin.PngInfo()
    info.add_text("Comment", text or "")
    picture = Image.fromarray(np.arange(12, dtype=np.uint8).reshape(3, 4))
    (picture if text else picture.convert("P")).save(buffer, "PNG", pnginfo=info)
    assert png_pixels(buffer.getvalue()) is None
    np.testing.assert_array_equal(read_image(PictureBytes("it", buffer.getvalue()))[..., :1].reshape(3, -1)[:, 0], [0, 4, 8])


def test_what_is_not_whole_is_left_to_pillow():
    data = png(np.zeros((6, 9, 3), np.uint8), [4])
    assert png_pixels(data) is not None
    assert png_pixels(data[:60]) is None
    assert png_pixels(png(np.zeros((6, 9), np.uint8), [5])) is None
    short = data[:8] + chunk(b"IHDR", struct.pack(">IIBBBBB", 9, 7, 8, 2, 0, 0, 0)) + data[33:]
    assert png_pixels(short) is None
    assert png_pixels(b"") is None
