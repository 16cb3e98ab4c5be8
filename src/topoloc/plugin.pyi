"""Names for extensions, and the modules that define them."""

from topoloc.apps.formats.image_lists import (
    match_times as match_times,
    parse_relative_path as parse_relative_path,
)
from topoloc.apps.formats.video import Video as Video
from topoloc.bounds import (
    Above as Above,
    AtLeast as AtLeast,
    Between as Between,
    with_setting as with_setting,
)
from topoloc.features.feature_types import (
    FeatureConfig as FeatureConfig,
    FeatureType as FeatureType,
    GuidedThresholds as GuidedThresholds,
    register_feature_type as register_feature_type,
)
from topoloc.features.features import Features as Features
from topoloc.features.network_files import cache_folder as cache_folder
from topoloc.json_data import Finite as Finite, decode_json as decode_json
from topoloc.recordings.atomic import (
    atomic_write as atomic_write,
    write_bytes as write_bytes,
    write_folder as write_folder,
    write_text as write_text,
)
from topoloc.recordings.camera_files import (
    CameraCalibration as CameraCalibration,
    read_camera_json as read_camera_json,
)
from topoloc.recordings.format import (
    RecordingFormat as RecordingFormat,
    list_images as list_images,
    natural_key as natural_key,
    read_ground_truth as read_ground_truth,
    times_from_rate as times_from_rate,
)
from topoloc.recordings.frame import IndexedFrames as IndexedFrames
from topoloc.recordings.image_io import (
    EncodedImage as EncodedImage,
    depth_image_of as depth_image_of,
    image_size as image_size,
    read_depth_image as read_depth_image,
)
from topoloc.recordings.recording import DepthImages as DepthImages, Recording as Recording
from topoloc.recordings.text_files import read_text as read_text
from topoloc.retrieval.coarse import (
    CoarseLocalizer as CoarseLocalizer,
    CoarseModel as CoarseModel,
    NodeScore as NodeScore,
    register_coarse_localizer as register_coarse_localizer,
)

__all__: list[str]
