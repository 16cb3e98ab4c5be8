"""topoloc: a place mapped once with a stereo or RGB-D camera; afterwards any single image of it
gets a metric 6-DoF pose.

The public names; each loads its module when it is first asked for, so that `import topoloc` costs
nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from topoloc.apps.export.formats import export
    from topoloc.apps.report.explanation import explain
    from topoloc.apps.service.client import AsyncClient, Client
    from topoloc.apps.viewer.page import view
    from topoloc.atlas.atlas import Atlas
    from topoloc.atlas.config import AtlasConfig
    from topoloc.atlas.location_prior import GeoPositionPrior
    from topoloc.atlas.manifest import Tile
    from topoloc.atlas.map_cache import MapCache
    from topoloc.atlas.place import SharedWorld, SingleMap, open_place
    from topoloc.compiled import set_num_threads
    from topoloc.errors import (
        AtlasError,
        CalibrationError,
        ClusterError,
        ConfigError,
        DuplicateSessionError,
        FeatureTypeError,
        GeoreferenceError,
        MapError,
        MapNotFoundError,
        MissingExtraError,
        ObjectStoreError,
        QueryError,
        RecordingError,
        ResultError,
        ServiceError,
        TopolocError,
        TrajectoryError,
        UnreadableImageError,
        WeightsError,
    )
    from topoloc.evaluation.metrics import EvaluatedQuery
    from topoloc.evaluation.query_localization import (
        Evaluation,
        evaluate,
        find_frames_with_truth,
        localize_out_of_map,
        localize_queries,
    )
    from topoloc.evaluation.world_alignment import WorldFit
    from topoloc.geometry.camera import Camera
    from topoloc.geometry.geodesy import GeoPoint, GeoPose, Georeference
    from topoloc.geometry.pose_conventions import PoseConventions
    from topoloc.geometry.rig import StereoRig
    from topoloc.geometry.rigid import Rigid3
    from topoloc.geometry.uncalibrated_camera import UncalibratedCamera
    from topoloc.lifelong.merge import merge
    from topoloc.lifelong.prune import prune
    from topoloc.lifelong.tiles.tile_joining import PairResult, find_tile_of_recording, join_tiles
    from topoloc.lifelong.update import MapUpdate, update
    from topoloc.lifelong.weak_regions import (
        NodeQuality,
        WeakRegion,
        WeakRegions,
        find_weak_regions,
    )
    from topoloc.localization.image_calibration_check import check_camera_calibrations
    from topoloc.localization.localizer import Localizer, LocalizerConfig
    from topoloc.localization.map_facts.contradictions import check_map
    from topoloc.localization.map_facts.map_building import build_map
    from topoloc.localization.provenance import Provenance
    from topoloc.localization.result import (
        Alternative,
        Localization,
        NotLocalized,
        result_from_json,
    )
    from topoloc.localization.search import Trace, TriedProposal
    from topoloc.mapping.build import BuildConfig
    from topoloc.mapping.edit import read_history, undo_edit
    from topoloc.mapping.georeference import GeoreferenceResult, georeference
    from topoloc.mapping.sessions import Illumination
    from topoloc.mapping.storage.entries import TopoNode
    from topoloc.mapping.topomap import TopoMetricMap
    from topoloc.recordings.frame import DepthImage, Image, StereoFrame, StereoSequence
    from topoloc.recordings.frame_checks import MemorySequence
    from topoloc.recordings.image_io import read_depth, read_image
    from topoloc.recordings.open import open_sequence
    from topoloc.recordings.trajectory import (
        Trajectory,
        align_to_trajectory,
        with_pose_conventions,
        with_trajectory,
    )
    from topoloc.slam.slam import SlamResult, run_slam
    from topoloc.tracking.config import TrackerConfig
    from topoloc.tracking.stream_result import StreamedPose
    from topoloc.tracking.tracker import Tracker
    from topoloc.tracking.warm_up import warm_up

    __version__: str

__all__ = [
    "Alternative",
    "AsyncClient",
    "Atlas",
    "AtlasConfig",
    "AtlasError",
    "BuildConfig",
    "CalibrationError",
    "Camera",
    "Client",
    "ClusterError",
    "ConfigError",
    "DepthImage",
    "DuplicateSessionError",
    "EvaluatedQuery",
    "Evaluation",
    "FeatureTypeError",
    "GeoPoint",
    "GeoPose",
    "GeoPositionPrior",
    "Georeference",
    "GeoreferenceError",
    "GeoreferenceResult",
    "Illumination",
    "Image",
    "Localization",
    "Localizer",
    "LocalizerConfig",
    "MapCache",
    "MapError",
    "MapNotFoundError",
    "MapUpdate",
    "MemorySequence",
    "MissingExtraError",
    "NodeQuality",
    "NotLocalized",
    "ObjectStoreError",
    "PairResult",
    "PoseConventions",
    "Provenance",
    "QueryError",
    "RecordingError",
    "ResultError",
    "Rigid3",
    "ServiceError",
    "SharedWorld",
    "SingleMap",
    "SlamResult",
    "StereoFrame",
    "StereoRig",
    "StereoSequence",
    "StreamedPose",
    "Tile",
    "TopoMetricMap",
    "TopoNode",
    "TopolocError",
    "Trace",
    "Tracker",
    "TrackerConfig",
    "Trajectory",
    "TrajectoryError",
    "TriedProposal",
    "UncalibratedCamera",
    "UnreadableImageError",
    "WeakRegion",
    "WeakRegions",
    "WeightsError",
    "WorldFit",
    "__version__",
    "align_to_trajectory",
    "build_map",
    "check_camera_calibrations",
    "check_map",
    "evaluate",
    "explain",
    "export",
    "find_frames_with_truth",
    "find_tile_of_recording",
    "find_weak_regions",
    "georeference",
    "join_tiles",
    "localize_out_of_map",
    "localize_queries",
    "merge",
    "open_place",
    "open_sequence",
    "prune",
    "read_depth",
    "read_history",
    "read_image",
    "result_from_json",
    "run_slam",
    "set_num_threads",
    "undo_edit",
    "update",
    "view",
    "warm_up",
    "with_pose_conventions",
    "with_trajectory",
]

_NAMES = {
    "topoloc.apps.export.formats": "export",
    "topoloc.apps.report.explanation": "explain",
    "topoloc.apps.service.client": "AsyncClient Client",
    "topoloc.apps.viewer.page": "view",
    "topoloc.atlas.atlas": "Atlas",
    "topoloc.atlas.config": "AtlasConfig",
    "topoloc.atlas.location_prior": "GeoPositionPrior",
    "topoloc.atlas.manifest": "Tile",
    "topoloc.atlas.map_cache": "MapCache",
    "topoloc.atlas.place": "SharedWorld SingleMap open_place",
    "topoloc.compiled": "set_num_threads",
    "topoloc.errors": (
        "AtlasError CalibrationError ClusterError ConfigError DuplicateSessionError "
        "FeatureTypeError GeoreferenceError MapError MapNotFoundError MissingExtraError "
        "ObjectStoreError QueryError RecordingError ResultError ServiceError TopolocError "
        "TrajectoryError UnreadableImageError WeightsError"
    ),
    "topoloc.evaluation.metrics": "EvaluatedQuery",
    "topoloc.evaluation.query_localization": (
        "Evaluation evaluate find_frames_with_truth localize_out_of_map localize_queries"
    ),
    "topoloc.evaluation.world_alignment": "WorldFit",
    "topoloc.geometry.camera": "Camera",
    "topoloc.geometry.geodesy": "GeoPoint GeoPose Georeference",
    "topoloc.geometry.pose_conventions": "PoseConventions",
    "topoloc.geometry.rig": "StereoRig",
    "topoloc.geometry.rigid": "Rigid3",
    "topoloc.geometry.uncalibrated_camera": "UncalibratedCamera",
    "topoloc.lifelong.merge": "merge",
    "topoloc.lifelong.prune": "prune",
    "topoloc.lifelong.tiles.tile_joining": "PairResult find_tile_of_recording join_tiles",
    "topoloc.lifelong.update": "MapUpdate update",
    "topoloc.lifelong.weak_regions": "NodeQuality WeakRegion WeakRegions find_weak_regions",
    "topoloc.localization.image_calibration_check": "check_camera_calibrations",
    "topoloc.localization.localizer": "Localizer LocalizerConfig",
    "topoloc.localization.map_facts.contradictions": "check_map",
    "topoloc.localization.map_facts.map_building": "build_map",
    "topoloc.localization.provenance": "Provenance",
    "topoloc.localization.result": "Alternative Localization NotLocalized result_from_json",
    "topoloc.localization.search": "Trace TriedProposal",
    "topoloc.mapping.build": "BuildConfig",
    "topoloc.mapping.edit": "read_history undo_edit",
    "topoloc.mapping.georeference": "GeoreferenceResult georeference",
    "topoloc.mapping.sessions": "Illumination",
    "topoloc.mapping.storage.entries": "TopoNode",
    "topoloc.mapping.topomap": "TopoMetricMap",
    "topoloc.recordings.frame": "DepthImage Image StereoFrame StereoSequence",
    "topoloc.recordings.image_io": "read_depth read_image",
    "topoloc.recordings.frame_checks": "MemorySequence",
    "topoloc.recordings.open": "open_sequence",
    "topoloc.recordings.trajectory": (
        "Trajectory align_to_trajectory with_pose_conventions with_trajectory"
    ),
    "topoloc.slam.slam": "SlamResult run_slam",
    "topoloc.tracking.config": "TrackerConfig",
    "topoloc.tracking.stream_result": "StreamedPose",
    "topoloc.tracking.tracker": "Tracker",
    "topoloc.tracking.warm_up": "warm_up",
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("topoloc")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value = getattr(importlib.import_module(_MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    return list(__all__)
