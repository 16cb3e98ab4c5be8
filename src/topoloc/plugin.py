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
        describe_range,
        field_annotations,
        find_violation,
        parse_settings,
        quote_key,
        suggest_name,
    )
    from topoloc.evaluation.metrics import format_length
    from topoloc.features.feature_types import check_available, parse_feature_types
    from topoloc.features.network_files import NETWORKS, NetworkInfo, cache_folder, read_bytes
    from topoloc.mapping.build import Progress
    from topoloc.mapping.sessions import find_source_path
    from topoloc.recordings.atomic import atomic_write, remove_stale_files, write_text
    from topoloc.recordings.calibration import parse_calibration
    from topoloc.recordings.format import RecordingFormat
    from topoloc.recordings.json_file import read_json
    from topoloc.recordings.open import find_format, split_selection
    from topoloc.recordings.recording import (
        Recording,
        as_monocular,
        has_scale,
        recording_notes,
        scale_poses,
    )
    from topoloc.recordings.text_files import read_text
    from topoloc.recordings.trajectory import match_frame_poses

__all__ = [
    "NETWORKS",
    "NetworkInfo",
    "Progress",
    "Recording",
    "RecordingFormat",
    "as_monocular",
    "atomic_write",
    "cache_folder",
    "check_available",
    "describe_range",
    "field_annotations",
    "find_format",
    "find_source_path",
    "find_violation",
    "format_length",
    "has_scale",
    "match_frame_poses",
    "parse_calibration",
    "parse_feature_types",
    "parse_settings",
    "quote_key",
    "read_bytes",
    "read_json",
    "read_text",
    "recording_notes",
    "remove_stale_files",
    "scale_poses",
    "split_selection",
    "suggest_name",
    "write_text",
]

_MODULES = {
    "NETWORKS": "topoloc.features.network_files",
    "NetworkInfo": "topoloc.features.network_files",
    "Progress": "topoloc.mapping.build",
    "Recording": "topoloc.recordings.recording",
    "RecordingFormat": "topoloc.recordings.format",
    "as_monocular": "topoloc.recordings.recording",
    "atomic_write": "topoloc.recordings.atomic",
    "cache_folder": "topoloc.features.network_files",
    "check_available": "topoloc.features.feature_types",
    "describe_range": "topoloc.bounds",
    "field_annotations": "topoloc.bounds",
    "find_format": "topoloc.recordings.open",
    "find_source_path": "topoloc.mapping.sessions",
    "find_violation": "topoloc.bounds",
    "format_length": "topoloc.evaluation.metrics",
    "has_scale": "topoloc.recordings.recording",
    "match_frame_poses": "topoloc.recordings.trajectory",
    "parse_calibration": "topoloc.recordings.calibration",
    "parse_feature_types": "topoloc.features.feature_types",
    "parse_settings": "topoloc.bounds",
    "quote_key": "topoloc.bounds",
    "read_bytes": "topoloc.features.network_files",
    "read_json": "topoloc.recordings.json_file",
    "read_text": "topoloc.recordings.text_files",
    "recording_notes": "topoloc.recordings.recording",
    "remove_stale_files": "topoloc.recordings.atomic",
    "scale_poses": "topoloc.recordings.recording",
    "split_selection": "topoloc.recordings.open",
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
