"""Names for applications alone, and the modules that define them."""

from topoloc.atlas.manifest import check_tile_id as check_tile_id
from topoloc.atlas.map_cache import RETRY_AFTER_S as RETRY_AFTER_S
from topoloc.bounds import (
    describe_ranges as describe_ranges,
    parse_tables as parse_tables,
    suggest_name as suggest_name,
)
from topoloc.compiled import kernel_caches as kernel_caches
from topoloc.evaluation.metrics import format_length as format_length
from topoloc.evaluation.node_matching import NodeMatcher as NodeMatcher
from topoloc.features.feature_types import find_available_types as find_available_types
from topoloc.features.network_files import (
    NetworkInfo as NetworkInfo,
    find_telemetry as find_telemetry,
)
from topoloc.geometry.alignment import (
    align_similarity as align_similarity,
    nearest_rotation as nearest_rotation,
)
from topoloc.geometry.transform_consensus import find_least_median as find_least_median
from topoloc.json_data import OneLine as OneLine, Positive as Positive
from topoloc.lifelong.merge import rescale_map as rescale_map
from topoloc.lifelong.node_localization import (
    LeaveOneOutResult as LeaveOneOutResult,
    find_near_nodes as find_near_nodes,
    localize_left_out as localize_left_out,
    sample_evenly as sample_evenly,
)
from topoloc.localization.query import Deadline as Deadline, QueryImage as QueryImage
from topoloc.mapping.certificate import (
    Certificate as Certificate,
    CertifiedCondition as CertifiedCondition,
    CertifiedGroup as CertifiedGroup,
    ConditionKind as ConditionKind,
    GroupKind as GroupKind,
    Quarter as Quarter,
)
from topoloc.mapping.edit import edit_map as edit_map
from topoloc.mapping.junctions import (
    WalkGraph as WalkGraph,
)
from topoloc.mapping.nodes import NodePoses as NodePoses, node_distances as node_distances
from topoloc.mapping.storage.entries import today as today
from topoloc.node_ids import NodeId as NodeId, Row as Row
from topoloc.recordings.atomic import (
    close as close,
    collect_written_paths as collect_written_paths,
    open_to_lock as open_to_lock,
    remove_stale_files as remove_stale_files,
    temporary_folder as temporary_folder,
    try_lock as try_lock,
    wait_for_lock as wait_for_lock,
)
from topoloc.recordings.calibration import (
    CalibrationForSize as CalibrationForSize,
    find_calibration as find_calibration,
    first_image_size as first_image_size,
    parse_calibration as parse_calibration,
    replace_cameras as replace_cameras,
    with_calibration as with_calibration,
)
from topoloc.recordings.camera_files import (
    kalibr_camera as kalibr_camera,
    make_camera as make_camera,
    make_rig as make_rig,
    read_yaml as read_yaml,
    require_numbers as require_numbers,
    yaml_image_size as yaml_image_size,
    yaml_numbers as yaml_numbers,
    yaml_word as yaml_word,
)
from topoloc.recordings.exif import (
    exif_focal_length as exif_focal_length,
    exif_place as exif_place,
)
from topoloc.recordings.format import complete_lists as complete_lists, read_times as read_times
from topoloc.recordings.frame import SequenceView as SequenceView, to_grey as to_grey
from topoloc.recordings.frame_preparation import prepare_frame as prepare_frame
from topoloc.recordings.image_files import find_path as find_path
from topoloc.recordings.image_io import (
    IMAGE_SUFFIXES as IMAGE_SUFFIXES,
    MAX_PIXELS as MAX_PIXELS,
    find_white_level as find_white_level,
)
from topoloc.recordings.named_poses import read_pose_matrix as read_pose_matrix
from topoloc.recordings.open import (
    find_format as find_format,
    select_frames as select_frames,
    split_selection as split_selection,
)
from topoloc.recordings.recording import (
    RightImages as RightImages,
    as_monocular as as_monocular,
    has_scale as has_scale,
    keep_frames as keep_frames,
    read_left_frame as read_left_frame,
    scale_poses as scale_poses,
)
from topoloc.recordings.stored_images import encode_jpeg as encode_jpeg
from topoloc.recordings.text_files import (
    parse_numbers as parse_numbers,
    parse_times as parse_times,
    read_rows as read_rows,
    with_decimal_points as with_decimal_points,
)
from topoloc.recordings.trajectory import (
    has_answers as has_answers,
    timed_trajectory as timed_trajectory,
)
from topoloc.rigs.mountings import Mounting as Mounting, find_mountings as find_mountings
from topoloc.rigs.rig import RigFrame as RigFrame
from topoloc.slam.view_graph import match_views as match_views

__all__: list[str]
