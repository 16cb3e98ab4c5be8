"""Interfaces and helpers for extensions: recording formats, feature types, coarse localizers,
stores and exporters.

Extensions import from here and from `topoloc`. Each name loads its module at its first use, so
that importing this module is free.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from topoloc.atlas.manifest import check_tile_id as check_tile_id
    from topoloc.atlas.tile_fetcher import TilePending as TilePending
    from topoloc.bounds import (
        Above as Above,
        AtLeast as AtLeast,
        Between as Between,
        describe_ranges as describe_ranges,
        suggest_name as suggest_name,
        with_setting as with_setting,
    )
    from topoloc.compiled import kernel_caches as kernel_caches
    from topoloc.evaluation.metrics import format_length as format_length
    from topoloc.evaluation.node_matching import NodeMatcher as NodeMatcher
    from topoloc.features.feature_types import (
        FeatureConfig as FeatureConfig,
        FeatureType as FeatureType,
        GuidedThresholds as GuidedThresholds,
        find_available_types as find_available_types,
        register_feature_type as register_feature_type,
    )
    from topoloc.features.features import Features as Features
    from topoloc.features.network_files import (
        NetworkInfo as NetworkInfo,
        cache_folder as cache_folder,
    )
    from topoloc.features.onnx_runtime import find_telemetry as find_telemetry
    from topoloc.json_data import Finite as Finite, decode_json as decode_json
    from topoloc.localization.query import Deadline as Deadline
    from topoloc.recordings.atomic import (
        atomic_write as atomic_write,
        collect_written_paths as collect_written_paths,
        remove_stale_files as remove_stale_files,
        temporary_folder as temporary_folder,
        write_bytes as write_bytes,
        write_folder as write_folder,
        write_text as write_text,
    )
    from topoloc.recordings.calibration import (
        parse_calibration as parse_calibration,
        replace_cameras as replace_cameras,
    )
    from topoloc.recordings.camera_json import (
        CameraCalibration as CameraCalibration,
        read_camera_json as read_camera_json,
    )
    from topoloc.recordings.depth_images import (
        depth_image_of as depth_image_of,
        read_depth_image as read_depth_image,
    )
    from topoloc.recordings.format import (
        RecordingFormat as RecordingFormat,
        list_images as list_images,
        match_times as match_times,
        natural_key as natural_key,
        read_ground_truth as read_ground_truth,
        times_from_rate as times_from_rate,
    )
    from topoloc.recordings.formats.video import Video as Video, silence_opencv as silence_opencv
    from topoloc.recordings.frame import IndexedFrames as IndexedFrames
    from topoloc.recordings.image_io import (
        MAX_PIXELS as MAX_PIXELS,
        EncodedImage as EncodedImage,
        exif_focal_length as exif_focal_length,
        find_white_level as find_white_level,
        image_size as image_size,
    )
    from topoloc.recordings.open import (
        find_format as find_format,
        split_selection as split_selection,
    )
    from topoloc.recordings.recording import (
        DepthImages as DepthImages,
        Recording as Recording,
        as_monocular as as_monocular,
        has_scale as has_scale,
        scale_poses as scale_poses,
    )
    from topoloc.recordings.ros_calibration import RosCalibration as RosCalibration
    from topoloc.recordings.stored_images import encode_jpeg as encode_jpeg
    from topoloc.recordings.text_files import (
        parse_relative_path as parse_relative_path,
        read_text as read_text,
    )
    from topoloc.recordings.trajectory import has_answers as has_answers
    from topoloc.removed_settings import parse_tables as parse_tables
    from topoloc.retrieval.coarse import (
        CoarseLocalizer as CoarseLocalizer,
        CoarseModel as CoarseModel,
        NodeScore as NodeScore,
        register_coarse_localizer as register_coarse_localizer,
    )

_NAMES = {
    "topoloc.atlas.manifest": "check_tile_id",
    "topoloc.atlas.tile_fetcher": "TilePending",
    "topoloc.bounds": "Above AtLeast Between describe_ranges suggest_name with_setting",
    "topoloc.compiled": "kernel_caches",
    "topoloc.evaluation.metrics": "format_length",
    "topoloc.evaluation.node_matching": "NodeMatcher",
    "topoloc.features.feature_types": (
        "FeatureConfig FeatureType GuidedThresholds find_available_types register_feature_type"
    ),
    "topoloc.features.features": "Features",
    "topoloc.features.network_files": "NetworkInfo cache_folder",
    "topoloc.features.onnx_runtime": "find_telemetry",
    "topoloc.json_data": "Finite decode_json",
    "topoloc.localization.query": "Deadline",
    "topoloc.recordings.atomic": (
        "atomic_write collect_written_paths remove_stale_files temporary_folder write_bytes"
        " write_folder write_text"
    ),
    "topoloc.recordings.calibration": "parse_calibration replace_cameras",
    "topoloc.recordings.camera_json": "CameraCalibration read_camera_json",
    "topoloc.recordings.depth_images": "read_depth_image depth_image_of",
    "topoloc.recordings.format": (
        "RecordingFormat list_images match_times natural_key read_ground_truth times_from_rate"
    ),
    "topoloc.recordings.formats.video": "Video silence_opencv",
    "topoloc.recordings.frame": "IndexedFrames",
    "topoloc.recordings.image_io": (
        "EncodedImage MAX_PIXELS exif_focal_length find_white_level image_size"
    ),
    "topoloc.recordings.open": "find_format split_selection",
    "topoloc.recordings.recording": "DepthImages Recording as_monocular has_scale scale_poses",
    "topoloc.recordings.ros_calibration": "RosCalibration",
    "topoloc.recordings.stored_images": "encode_jpeg",
    "topoloc.recordings.text_files": "parse_relative_path read_text",
    "topoloc.recordings.trajectory": "has_answers",
    "topoloc.removed_settings": "parse_tables",
    "topoloc.retrieval.coarse": "CoarseLocalizer CoarseModel NodeScore register_coarse_localizer",
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}
__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value = getattr(importlib.import_module(_MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    return list(__all__)
