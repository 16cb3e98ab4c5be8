"""Interfaces and helpers for extensions: recording formats, feature types, coarse localizers,
stores and exporters.

Extensions import from here and from `topoloc`. Each name loads its module at its first use, so
that importing this module is free.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from topoloc.recordings.atomic import atomic_write, write_text
    from topoloc.recordings.format import RecordingFormat
    from topoloc.recordings.json_file import read_json
    from topoloc.recordings.recording import Recording
    from topoloc.recordings.text_files import read_text

__all__ = [
    "Recording",
    "RecordingFormat",
    "atomic_write",
    "read_json",
    "read_text",
    "write_text",
]

_MODULES = {
    "Recording": "topoloc.recordings.recording",
    "RecordingFormat": "topoloc.recordings.format",
    "atomic_write": "topoloc.recordings.atomic",
    "read_json": "topoloc.recordings.json_file",
    "read_text": "topoloc.recordings.text_files",
    "write_text": "topoloc.recordings.atomic",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return list(__all__)
