"""Names for applications alone, and the modules that define them."""

from topoloc.atlas.manifest import check_tile_id as check_tile_id
from topoloc.atlas.tile_fetcher import TilePending as TilePending
from topoloc.bounds import (
    describe_ranges as describe_ranges,
    parse_tables as parse_tables,
    suggest_name as suggest_name,
)
from topoloc.compiled import kernel_caches as kernel_caches
from topoloc.evaluation.metrics import format_length as format_length
from topoloc.evaluation.node_matching import NodeMatcher as NodeMatcher
from topoloc.features.feature_types import find_available_types as find_available_types
from topoloc.features.network_files import NetworkInfo as NetworkInfo
from topoloc.features.onnx_runtime import find_telemetry as find_telemetry
from topoloc.localization.query import Deadline as Deadline
from topoloc.recordings.atomic import (
    collect_written_paths as collect_written_paths,
    remove_stale_files as remove_stale_files,
    temporary_folder as temporary_folder,
)
from topoloc.recordings.calibration import (
    CalibrationForSize as CalibrationForSize,
    first_image_size as first_image_size,
    parse_calibration as parse_calibration,
    replace_cameras as replace_cameras,
    with_calibration as with_calibration,
)
from topoloc.recordings.formats.video import silence_opencv as silence_opencv
from topoloc.recordings.image_files import find_path as find_path
from topoloc.recordings.image_io import (
    MAX_PIXELS as MAX_PIXELS,
    exif_focal_length as exif_focal_length,
    find_white_level as find_white_level,
)
from topoloc.recordings.open import find_format as find_format, split_selection as split_selection
from topoloc.recordings.recording import (
    as_monocular as as_monocular,
    has_scale as has_scale,
    keep_frames as keep_frames,
    scale_poses as scale_poses,
)
from topoloc.recordings.ros_calibration import RosCalibration as RosCalibration
from topoloc.recordings.stored_images import encode_jpeg as encode_jpeg
from topoloc.recordings.trajectory import has_answers as has_answers

__all__: list[str]
