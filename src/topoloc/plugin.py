"""Interfaces and helpers for the authors of extensions: recording formats, feature types, coarse
localizers, stores of atlases, exporters.

A lazy table as in `topoloc`: each name loads its module at its first use.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from topoloc.atlas.tile_fetcher import TilePending
    from topoloc.bounds import Above, AtLeast, Between
    from topoloc.evaluation.metrics import format_length, group_by_recording
    from topoloc.localization.checked_json import pose_from_json, pose_to_json
    from topoloc.localization.node_matching import NodeMatcher
    from topoloc.localization.query_camera import parse_camera_option
    from topoloc.recordings.atomic import write_bytes, write_folder, write_text
    from topoloc.recordings.frame import Image
    from topoloc.recordings.image_io import EncodedImage, encode_jpeg, exif_focal_length, image_size
    from topoloc.recordings.text_files import read_text
    from topoloc.recordings.trajectory import tum_text

__all__ = [
    "Above",
    "AtLeast",
    "Between",
    "EncodedImage",
    "Image",
    "NodeMatcher",
    "TilePending",
    "encode_jpeg",
    "exif_focal_length",
    "format_length",
    "group_by_recording",
    "image_size",
    "parse_camera_option",
    "pose_from_json",
    "pose_to_json",
    "read_text",
    "tum_text",
    "write_bytes",
    "write_folder",
    "write_text",
]

_MODULES = {
    "Above": "topoloc.bounds",
    "AtLeast": "topoloc.bounds",
    "Between": "topoloc.bounds",
    "EncodedImage": "topoloc.recordings.image_io",
    "Image": "topoloc.recordings.frame",
    "NodeMatcher": "topoloc.localization.node_matching",
    "TilePending": "topoloc.atlas.tile_fetcher",
    "encode_jpeg": "topoloc.recordings.image_io",
    "exif_focal_length": "topoloc.recordings.image_io",
    "format_length": "topoloc.evaluation.metrics",
    "group_by_recording": "topoloc.evaluation.metrics",
    "image_size": "topoloc.recordings.image_io",
    "parse_camera_option": "topoloc.localization.query_camera",
    "pose_from_json": "topoloc.localization.checked_json",
    "pose_to_json": "topoloc.localization.checked_json",
    "read_text": "topoloc.recordings.text_files",
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
