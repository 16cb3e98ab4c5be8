"""Find image files by their names, and tell why one is not read."""

from __future__ import annotations

import io
import os
import struct
import unicodedata
from contextlib import suppress
from pathlib import Path

from PIL import TiffImagePlugin

_STARTS = {b"\x89PNG": "PNG", b"\xff\xd8": "JPEG", b"BM": "BMP", b"RIFF": "WebP"}
_STARTS |= dict.fromkeys((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), "TIFF")
_BITS, _KIND = 258, 339  # tags of TIFF: bits of a sample, and what they are
_KINDS = {2: "signed integers", 3: "floats", 5: "complex integers", 6: "complex numbers"}


def find_path(path: Path) -> Path:
    """Return the path, or the only existing one with the same letters in another form of Unicode. A
    Mac may write a letter and its accent apart (NFD), a list them as one (NFC)."""
    if str(path).isascii() or os.path.exists(path):
        return path
    folder = path.parent if path.parent == path else find_path(path.parent)
    others = [folder / unicodedata.normalize(form, path.name) for form in ("NFC", "NFD")]
    return next(filter(os.path.exists, others), path)


def unreadable_reason(data: bytes) -> str:
    """Return why Pillow does not read this file."""
    known = next((name for start, name in _STARTS.items() if data.startswith(start)), None)
    if known is None:
        return "not a picture, or not of a known type (PNG, JPEG, BMP, PNM, TIFF, WebP, HEIC)"
    if known == "TIFF" and (pixels := _unknown_pixels(data)):
        return unknown_pixels_reason(pixels)
    return f"damaged or truncated {known} file"


def unknown_pixels_reason(pixels: str) -> str:
    """Return the reason and the remedy for pixels such as "32-bit floats"."""
    return (
        f"pixels of {pixels}; a picture needs integers of 8 or 16 bits a channel (depth 16 bits, or"
        " 32-bit floats)"
    )


def _unknown_pixels(data: bytes) -> str | None:
    """Return the pixels of a TIFF that are no integers of up to 16 bits, such as "32-bit floats".
    None if they are, or its tags cannot be read."""
    with suppress(OSError, SyntaxError, ValueError, TypeError, LookupError, struct.error):
        header = data[: 16 if data[2] == 43 else 8]  # of BigTIFF, or TIFF
        tags, file = TiffImagePlugin.ImageFileDirectory_v2(header), io.BytesIO(data)
        file.seek(tags.next)
        tags.load(file)
        bits, kind = max(tags[_BITS]), max(tags.get(_KIND, (1,)))
        if kind != 1 or bits not in (1, 2, 4, 8, 16):
            return f"{bits}-bit {_KINDS.get(kind, 'integers')}"
    return None
