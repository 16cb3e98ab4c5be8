"""Interfaces and helpers for extensions: recording formats, feature types, coarse localizers,
stores and exporters.

Extensions import from here and from `topoloc`. Each name loads its module at its first use, so
that importing this module is free.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from topoloc.bounds import (
        field_annotations,
        field_bounds,
        find_violation,
        parse_settings,
        quote_key,
        strip_annotation,
        suggest_name,
    )
    from topoloc.mapping.build import Progress
    from topoloc.recordings.atomic import atomic_write, remove_stale_files, write_text
    from topoloc.recordings.calibration import CalibrationForSize, parse_calibration
    from topoloc.recordings.format import RecordingFormat
    from topoloc.recordings.json_file import read_json
    from topoloc.recordings.recording import Recording
    from topoloc.recordings.text_files import read_text

__all__ = [
    "CalibrationForSize",
    "Progress",
    "Recording",
    "RecordingFormat",
    "atomic_write",
    "field_annotations",
    "field_bounds",
    "find_violation",
    "parse_calibration",
    "parse_settings",
    "quote_key",
    "read_json",
    "read_text",
    "remove_stale_files",
    "strip_annotation",
    "suggest_name",
    "write_text",
]

_MODULES = {
    "CalibrationForSize": "topoloc.recordings.calibration",
    "Progress": "topoloc.mapping.build",
    "Recording": "topoloc.recordings.recording",
    "RecordingFormat": "topoloc.recordings.format",
    "atomic_write": "topoloc.recordings.atomic",
    "field_annotations": "topoloc.bounds",
    "field_bounds": "topoloc.bounds",
    "find_violation": "topoloc.bounds",
    "parse_calibration": "topoloc.recordings.calibration",
    "parse_settings": "topoloc.bounds",
    "quote_key": "topoloc.bounds",
    "read_json": "topoloc.recordings.json_file",
    "read_text": "topoloc.recordings.text_files",
    "remove_stale_files": "topoloc.recordings.atomic",
    "strip_annotation": "topoloc.bounds",
    "suggest_name": "topoloc.bounds",
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
