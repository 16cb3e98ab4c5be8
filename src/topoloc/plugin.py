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
    from topoloc.bounds import Above, AtLeast, Between, suggest_name
    from topoloc.evaluation.metrics import format_length, group_by_recording
    from topoloc.features.network_files import cache_folder
    from topoloc.localization.checked_json import pose_from_json, pose_to_json
    from topoloc.localization.node_matching import NodeMatcher
    from topoloc.localization.query_camera import parse_camera_option
    from topoloc.recordings.atomic import (
        atomic_write,
        temporary_folder,
        write_bytes,
        write_folder,
        write_text,
    )
    from topoloc.recordings.camera_json import read_camera_json
    from topoloc.recordings.format import RecordingFormat
    from topoloc.recordings.frame import Image
    from topoloc.recordings.image_io import (
        MAX_PIXELS,
        EncodedImage,
        encode_jpeg,
        exif_focal_length,
        image_size,
    )
    from topoloc.recordings.json_file import (
        json_number,
        json_numbers,
        json_rigid,
        parse_relative_path,
        read_json,
    )
    from topoloc.recordings.recording import (
        DepthImages,
        Recording,
        find_nearest_idx,
        list_images,
        natural_key,
        times_from_rate,
    )
    from topoloc.recordings.text_files import read_text
    from topoloc.recordings.trajectory import interpolate_poses, read_ground_truth, tum_text
    from topoloc.recordings.video import Video, silence_opencv

__all__ = [
    "MAX_PIXELS",
    "Above",
    "AtLeast",
    "Between",
    "DepthImages",
    "EncodedImage",
    "Image",
    "NodeMatcher",
    "Recording",
    "RecordingFormat",
    "TilePending",
    "Video",
    "absolute_address",
    "atomic_write",
    "cache_folder",
    "check_tile_id",
    "encode_jpeg",
    "exif_focal_length",
    "find_nearest_idx",
    "format_length",
    "group_by_recording",
    "image_size",
    "interpolate_poses",
    "json_number",
    "json_numbers",
    "json_rigid",
    "list_images",
    "natural_key",
    "parse_camera_option",
    "parse_relative_path",
    "pose_from_json",
    "pose_to_json",
    "read_camera_json",
    "read_ground_truth",
    "read_json",
    "read_text",
    "silence_opencv",
    "suggest_name",
    "temporary_folder",
    "times_from_rate",
    "tum_text",
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
    "Image": "topoloc.recordings.frame",
    "MAX_PIXELS": "topoloc.recordings.image_io",
    "NodeMatcher": "topoloc.localization.node_matching",
    "Recording": "topoloc.recordings.recording",
    "RecordingFormat": "topoloc.recordings.format",
    "TilePending": "topoloc.atlas.tile_fetcher",
    "Video": "topoloc.recordings.video",
    "absolute_address": "topoloc.atlas.atlas",
    "atomic_write": "topoloc.recordings.atomic",
    "cache_folder": "topoloc.features.network_files",
    "check_tile_id": "topoloc.atlas.manifest",
    "encode_jpeg": "topoloc.recordings.image_io",
    "exif_focal_length": "topoloc.recordings.image_io",
    "find_nearest_idx": "topoloc.recordings.recording",
    "format_length": "topoloc.evaluation.metrics",
    "group_by_recording": "topoloc.evaluation.metrics",
    "image_size": "topoloc.recordings.image_io",
    "interpolate_poses": "topoloc.recordings.trajectory",
    "json_number": "topoloc.recordings.json_file",
    "json_numbers": "topoloc.recordings.json_file",
    "json_rigid": "topoloc.recordings.json_file",
    "list_images": "topoloc.recordings.recording",
    "natural_key": "topoloc.recordings.recording",
    "parse_camera_option": "topoloc.localization.query_camera",
    "parse_relative_path": "topoloc.recordings.json_file",
    "pose_from_json": "topoloc.localization.checked_json",
    "pose_to_json": "topoloc.localization.checked_json",
    "read_camera_json": "topoloc.recordings.camera_json",
    "read_ground_truth": "topoloc.recordings.trajectory",
    "read_json": "topoloc.recordings.json_file",
    "read_text": "topoloc.recordings.text_files",
    "silence_opencv": "topoloc.recordings.video",
    "suggest_name": "topoloc.bounds",
    "temporary_folder": "topoloc.recordings.atomic",
    "times_from_rate": "topoloc.recordings.recording",
    "tum_text": "topoloc.recordings.trajectory",
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
