"""The public names, and the modules that define them."""

from collections.abc import Callable
from typing import Any

from topoloc.apps.export.formats import export as export
from topoloc.apps.georeferencing.georeference import (
    GeoreferenceResult as GeoreferenceResult,
    georeference as georeference,
)
from topoloc.apps.quality.certification import Certification as Certification, certify as certify
from topoloc.apps.quality.weak_regions import (
    NodeQuality as NodeQuality,
    WeakRegion as WeakRegion,
    WeakRegions as WeakRegions,
    find_weak_regions as find_weak_regions,
)
from topoloc.apps.report.explanation import explain as explain
from topoloc.apps.service.client import AsyncClient as AsyncClient, Client as Client
from topoloc.apps.viewer.page import view as view
from topoloc.atlas.atlas import Atlas as Atlas
from topoloc.atlas.config import AtlasConfig as AtlasConfig
from topoloc.atlas.location_prior import GeoPositionPrior as GeoPositionPrior
from topoloc.atlas.manifest import Tile as Tile
from topoloc.atlas.map_cache import MapCache as MapCache
from topoloc.atlas.place import (
    SharedWorld as SharedWorld,
    SingleMap as SingleMap,
    open_place as open_place,
)
from topoloc.compiled import set_num_threads as set_num_threads
from topoloc.errors import (
    AtlasError as AtlasError,
    CalibrationError as CalibrationError,
    ClusterError as ClusterError,
    ConfigError as ConfigError,
    DuplicateSessionError as DuplicateSessionError,
    FeatureTypeError as FeatureTypeError,
    GeoreferenceError as GeoreferenceError,
    MapError as MapError,
    MapNotFoundError as MapNotFoundError,
    MissingExtraError as MissingExtraError,
    ObjectStoreError as ObjectStoreError,
    QueryError as QueryError,
    RecordingError as RecordingError,
    ResultError as ResultError,
    ServiceError as ServiceError,
    TopolocError as TopolocError,
    TrajectoryError as TrajectoryError,
    UnreadableImageError as UnreadableImageError,
    WeightsError as WeightsError,
)
from topoloc.evaluation.metrics import EvaluatedQuery as EvaluatedQuery, WorldFit as WorldFit
from topoloc.evaluation.query_localization import (
    Evaluation as Evaluation,
    evaluate as evaluate,
    find_frames_with_truth as find_frames_with_truth,
    localize_out_of_map as localize_out_of_map,
    localize_queries as localize_queries,
)
from topoloc.geometry.camera import Camera as Camera, UncalibratedCamera as UncalibratedCamera
from topoloc.geometry.geodesy import (
    GeoPoint as GeoPoint,
    GeoPose as GeoPose,
    Georeference as Georeference,
)
from topoloc.geometry.pose_conventions import PoseConventions as PoseConventions
from topoloc.geometry.rig import StereoRig as StereoRig
from topoloc.geometry.rigid import Rigid3 as Rigid3
from topoloc.lifelong.growing import GrowingMap as GrowingMap, Growth as Growth
from topoloc.lifelong.merge import merge as merge, move_map as move_map
from topoloc.lifelong.prune import prune as prune
from topoloc.lifelong.tiles.tile_joining import (
    PairResult as PairResult,
    find_tile_of_recording as find_tile_of_recording,
    join_tiles as join_tiles,
)
from topoloc.lifelong.update import MapUpdate as MapUpdate, update as update
from topoloc.localization.answer import Finding as Finding
from topoloc.localization.config import LocalizerConfig as LocalizerConfig
from topoloc.localization.image_calibration_check import (
    check_camera_calibrations as check_camera_calibrations,
)
from topoloc.localization.localizer import Localizer as Localizer
from topoloc.localization.map_facts.contradictions import check_map as check_map
from topoloc.localization.map_facts.map_building import build_map as build_map
from topoloc.localization.provenance import Provenance as Provenance
from topoloc.localization.result import (
    Alternative as Alternative,
    Localization as Localization,
    NotLocalized as NotLocalized,
    result_from_json as result_from_json,
)
from topoloc.localization.search import Trace as Trace, TriedProposal as TriedProposal
from topoloc.mapping.build import BuildConfig as BuildConfig
from topoloc.mapping.edit import read_history as read_history, undo_edit as undo_edit
from topoloc.mapping.storage.entries import Illumination as Illumination, TopoNode as TopoNode
from topoloc.mapping.topomap import TopoMetricMap as TopoMetricMap
from topoloc.recordings.frame import (
    DepthImage as DepthImage,
    Image as Image,
    MemorySequence as MemorySequence,
    StereoFrame as StereoFrame,
    StereoSequence as StereoSequence,
)
from topoloc.recordings.image_io import read_depth as read_depth, read_image as read_image
from topoloc.recordings.open import open_sequence as open_sequence
from topoloc.recordings.trajectory import (
    Trajectory as Trajectory,
    align_to_trajectory as align_to_trajectory,
    with_pose_conventions as with_pose_conventions,
    with_trajectory as with_trajectory,
)
from topoloc.rigs.rig import Rig as Rig, RigCamera as RigCamera, cut_panorama as cut_panorama
from topoloc.rigs.rig_localizer import RigLocalizer as RigLocalizer
from topoloc.rigs.rig_result import (
    RigLocalization as RigLocalization,
    RigNotLocalized as RigNotLocalized,
)
from topoloc.slam.slam import SlamResult as SlamResult, run_slam as run_slam
from topoloc.tracking.config import TrackerConfig as TrackerConfig
from topoloc.tracking.gyroscope import Gyroscope as Gyroscope
from topoloc.tracking.shared_cameras import SharedCameras as SharedCameras
from topoloc.tracking.stream_result import StreamedPose as StreamedPose
from topoloc.tracking.tracker import Tracker as Tracker
from topoloc.tracking.warm_up import warm_up as warm_up

def attach_stub(module: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]: ...

__version__: str
__all__: list[str]
