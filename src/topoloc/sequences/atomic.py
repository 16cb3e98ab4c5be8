"""Files written at once or not at all: a reader sees the old file or the new one, and a failure leaves nothing behind."""

from __future__ import annotations

import os
from pathlib import Path

from topoloc.errors import TopolocError


def write_text(path: Path, text: str) -> None:
    """Write text as UTF-8. Raises TopolocError where the file cannot be written."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: Path, data: bytes) -> None:
    """Write beside the file first, then rename over it. Raises TopolocError where the file cannot be written."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_bytes(data)
        os.replace(part, path)
    except OSError as error:
        raise TopolocError(f"cannot write {path}: {error.strerror}") from error
    finally:
        part.unlink(missing_ok=True)
