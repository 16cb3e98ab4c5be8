"""The usual PNG, of grey or RGB pixels: decoded in half the time that Pillow takes, most of which it spends on copies.

Whatever is unusual is left to Pillow: palettes, transparency, interlaced rows, texts that may hold an orientation, and all that is damaged,
so that what is refused is refused in its words.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator

import numpy as np
from jaxtyping import UInt8, UInt16

from topoloc.sequences.png_kernels import unfilter

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PLAIN = frozenset({b"IHDR", b"IDAT", b"IEND", b"gAMA", b"cHRM", b"sRGB", b"iCCP", b"sBIT", b"bKGD", b"pHYs", b"tIME"})
"""Chunks that say nothing of the pixels but what is read here."""
_BYTES_OF = {(8, 0): 1, (8, 2): 3, (16, 0): 2}
"""A pixel, by bits and colour type."""


def png_pixels(data: bytes) -> UInt8[np.ndarray, "h w"] | UInt8[np.ndarray, "h w 3"] | UInt16[np.ndarray, "h w"] | None:
    """The pixels of a PNG whose checksums were looked at; None where it is not one of the usual ones, or not whole."""
    chunks = list(_chunks(data))
    if not chunks or chunks[0][0] != b"IHDR" or len(chunks[0][1]) != 13 or not _PLAIN.issuperset(kind for kind, _ in chunks):
        return None
    header = chunks[0][1]
    width, height = int.from_bytes(header[:4], "big"), int.from_bytes(header[4:8], "big")
    step = _BYTES_OF.get((header[8], header[9]))
    if step is None or any(header[10:13]) or width == 0 or height == 0:
        return None
    size = height * (1 + width * step)
    try:
        filtered = zlib.decompressobj().decompress(b"".join(body for kind, body in chunks if kind == b"IDAT"), size)
    except zlib.error:
        return None
    pixels = np.empty((height, width * step), np.uint8)
    if len(filtered) != size or not unfilter(np.frombuffer(filtered, np.uint8).reshape(height, -1), step, pixels):
        return None
    if step == 2:
        return pixels.view(">u2").astype(np.uint16)
    return pixels if step == 1 else pixels.reshape(height, width, 3)


def _chunks(data: bytes) -> Iterator[tuple[bytes, memoryview]]:
    """Kind and content of each; none of what is no PNG, or ends early."""
    if not data.startswith(_SIGNATURE):
        return
    view, at = memoryview(data), len(_SIGNATURE)
    while at + 12 <= len(data):
        kind, end = data[at + 4 : at + 8], at + 12 + int.from_bytes(data[at : at + 4], "big")
        if end > len(data):
            return
        yield kind, view[at + 8 : end - 4]
        if kind == b"IEND":
            return
        at = end
