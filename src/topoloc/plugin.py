"""Interfaces and helpers for extensions: recording formats, feature types, coarse localizers,
stores and exporters.

Extensions import from here and from `topoloc`. Each name loads its module at its first use, so
that importing this module is free.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from topoloc.atlas.atlas import absolute_address
    from topoloc.atlas.manifest import check_tile_id
    from topoloc.atlas.tile_fetcher import TilePending
    from topoloc.bounds import (
        Above,
        AtLeast,
        Between,
        describe_range,
        field_annotations,
        find_violation,
        parse_settings,
        quote_key,
        suggest_name,
    )
    from topoloc.evaluation.metrics import format_length
    from topoloc.evaluation.node_matching import NodeMatcher
    from topoloc.features.feature_types import check_available, parse_feature_types
    from topoloc.features.network_files import NetworkInfo, cache_folder, read_bytes
    from topoloc.json_data import Finite, decode_json
    from topoloc.mapping.build import Progress
    from topoloc.recordings.atomic import (
        atomic_write,
        remove_stale_files,
        temporary_folder,
        write_bytes,
        write_folder,
        write_text,
    )
    from topoloc.recordings.calibration import parse_calibration
    from topoloc.recordings.camera_json import read_camera_json
    from topoloc.recordings.format import RecordingFormat
    from topoloc.recordings.formats.video import Video, silence_opencv
    from topoloc.recordings.image_io import (
        MAX_PIXELS,
        EncodedImage,
        encode_jpeg,
        exif_focal_length,
        image_size,
    )
    from topoloc.recordings.open import find_format, split_selection
    from topoloc.recordings.recording import (
        DepthImages,
        Recording,
        as_monocular,
        find_nearest_idx,
        find_source_path,
        has_scale,
        list_images,
        natural_key,
        recording_notes,
        scale_poses,
        times_from_rate,
    )
    from topoloc.recordings.text_files import parse_relative_path, read_text
    from topoloc.recordings.trajectory import (
        interpolate_poses,
        match_frame_poses,
        read_ground_truth,
    )
    from topoloc.removed_settings import drop_removed_settings


__all__ = [
    "MAX_PIXELS",
    "Above",
    "AtLeast",
    "Between",
    "DepthImages",
    "EncodedImage",
    "Finite",
    "NetworkInfo",
    "NodeMatcher",
    "Progress",
    "Recording",
    "RecordingFormat",
    "TilePending",
    "Video",
    "absolute_address",
    "as_monocular",
    "atomic_write",
    "cache_folder",
    "check_available",
    "check_tile_id",
    "decode_json",
    "describe_range",
    "drop_removed_settings",
    "encode_jpeg",
    "exif_focal_length",
    "field_annotations",
    "find_format",
    "find_nearest_idx",
    "find_source_path",
    "find_violation",
    "format_length",
    "has_scale",
    "image_size",
    "interpolate_poses",
    "list_images",
    "match_frame_poses",
    "natural_key",
    "parse_calibration",
    "parse_feature_types",
    "parse_relative_path",
    "parse_settings",
    "quote_key",
    "read_bytes",
    "read_camera_json",
    "read_ground_truth",
    "read_text",
    "recording_notes",
    "remove_stale_files",
    "scale_poses",
    "silence_opencv",
    "split_selection",
    "suggest_name",
    "temporary_folder",
    "times_from_rate",
    "write_bytes",
    "write_folder",
    "write_text",
]

_MODULES = {
    "Above": "topoloc.bounds",
    "AtLeast": "topoloc.bounds",
    "Between": "topoloc.bounds",
    "DepthImages": "topoloc.recordings.recording",
    "EncodedImage": "topoloc.recordings.image_io",
    "Finite": "topoloc.json_data",
    "MAX_PIXELS": "topoloc.recordings.image_io",
    "NetworkInfo": "topoloc.features.network_files",
    "NodeMatcher": "topoloc.evaluation.node_matching",
    "Progress": "topoloc.mapping.build",
    "Recording": "topoloc.recordings.recording",
    "RecordingFormat": "topoloc.recordings.format",
    "TilePending": "topoloc.atlas.tile_fetcher",
    "Video": "topoloc.recordings.formats.video",
    "absolute_address": "topoloc.atlas.atlas",
    "as_monocular": "topoloc.recordings.recording",
    "atomic_write": "topoloc.recordings.atomic",
    "cache_folder": "topoloc.features.network_files",
    "check_available": "topoloc.features.feature_types",
    "check_tile_id": "topoloc.atlas.manifest",
    "decode_json": "topoloc.json_data",
    "describe_range": "topoloc.bounds",
    "drop_removed_settings": "topoloc.removed_settings",
    "encode_jpeg": "topoloc.recordings.image_io",
    "exif_focal_length": "topoloc.recordings.image_io",
    "field_annotations": "topoloc.bounds",
    "find_format": "topoloc.recordings.open",
    "find_nearest_idx": "topoloc.recordings.recording",
    "find_source_path": "topoloc.recordings.recording",
    "find_violation": "topoloc.bounds",
    "format_length": "topoloc.evaluation.metrics",
    "has_scale": "topoloc.recordings.recording",
    "image_size": "topoloc.recordings.image_io",
    "interpolate_poses": "topoloc.recordings.trajectory",
    "list_images": "topoloc.recordings.recording",
    "match_frame_poses": "topoloc.recordings.trajectory",
    "natural_key": "topoloc.recordings.recording",
    "parse_calibration": "topoloc.recordings.calibration",
    "parse_feature_types": "topoloc.features.feature_types",
    "parse_relative_path": "topoloc.recordings.text_files",
    "parse_settings": "topoloc.bounds",
    "quote_key": "topoloc.bounds",
    "read_bytes": "topoloc.features.network_files",
    "read_camera_json": "topoloc.recordings.camera_json",
    "read_ground_truth": "topoloc.recordings.trajectory",
    "read_text": "topoloc.recordings.text_files",
    "recording_notes": "topoloc.recordings.recording",
    "remove_stale_files": "topoloc.recordings.atomic",
    "scale_poses": "topoloc.recordings.recording",
    "silence_opencv": "topoloc.recordings.formats.video",
    "split_selection": "topoloc.recordings.open",
    "suggest_name": "topoloc.bounds",
    "temporary_folder": "topoloc.recordings.atomic",
    "times_from_rate": "topoloc.recordings.recording",
    "write_bytes": "topoloc.recordings.atomic",
    "write_folder": "topoloc.recordings.atomic",
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
