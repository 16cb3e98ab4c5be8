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
    from topoloc.atlas.tile_fetcher import TileFetcher
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
    from topoloc.localization.map_facts.map_building import SkippedChecks, build_map
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
    from topoloc.recordings.image_io import read_depth, read_image
    from topoloc.recordings.memory_sequence import MemorySequence
    from topoloc.recordings.open import open_sequence
    from topoloc.recordings.trajectory import (
        Trajectory,
        with_pose_conventions,
        with_trajectory,
    )
    from topoloc.recordings.trajectory_alignment import align_to_trajectory
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
    "SkippedChecks",
    "SlamResult",
    "StereoFrame",
    "StereoRig",
    "StereoSequence",
    "StreamedPose",
    "Tile",
    "TileFetcher",
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

_MODULES = {
    "Alternative": "topoloc.localization.result",
    "AsyncClient": "topoloc.apps.service.client",
    "Atlas": "topoloc.atlas.atlas",
    "AtlasConfig": "topoloc.atlas.config",
    "AtlasError": "topoloc.errors",
    "BuildConfig": "topoloc.mapping.build",
    "CalibrationError": "topoloc.errors",
    "Camera": "topoloc.geometry.camera",
    "Client": "topoloc.apps.service.client",
    "ClusterError": "topoloc.errors",
    "ConfigError": "topoloc.errors",
    "DepthImage": "topoloc.recordings.frame",
    "DuplicateSessionError": "topoloc.errors",
    "EvaluatedQuery": "topoloc.evaluation.metrics",
    "Evaluation": "topoloc.evaluation.query_localization",
    "FeatureTypeError": "topoloc.errors",
    "GeoPoint": "topoloc.geometry.geodesy",
    "GeoPose": "topoloc.geometry.geodesy",
    "GeoPositionPrior": "topoloc.atlas.location_prior",
    "Georeference": "topoloc.geometry.geodesy",
    "GeoreferenceError": "topoloc.errors",
    "GeoreferenceResult": "topoloc.mapping.georeference",
    "Illumination": "topoloc.mapping.sessions",
    "Image": "topoloc.recordings.frame",
    "Localization": "topoloc.localization.result",
    "Localizer": "topoloc.localization.localizer",
    "LocalizerConfig": "topoloc.localization.localizer",
    "MapCache": "topoloc.atlas.map_cache",
    "MapError": "topoloc.errors",
    "MapNotFoundError": "topoloc.errors",
    "MapUpdate": "topoloc.lifelong.update",
    "MemorySequence": "topoloc.recordings.memory_sequence",
    "MissingExtraError": "topoloc.errors",
    "NodeQuality": "topoloc.lifelong.weak_regions",
    "NotLocalized": "topoloc.localization.result",
    "ObjectStoreError": "topoloc.errors",
    "PairResult": "topoloc.lifelong.tiles.tile_joining",
    "PoseConventions": "topoloc.geometry.pose_conventions",
    "Provenance": "topoloc.localization.provenance",
    "QueryError": "topoloc.errors",
    "RecordingError": "topoloc.errors",
    "ResultError": "topoloc.errors",
    "Rigid3": "topoloc.geometry.rigid",
    "ServiceError": "topoloc.errors",
    "SharedWorld": "topoloc.atlas.place",
    "SingleMap": "topoloc.atlas.place",
    "SkippedChecks": "topoloc.localization.map_facts.map_building",
    "SlamResult": "topoloc.slam.slam",
    "StereoFrame": "topoloc.recordings.frame",
    "StereoRig": "topoloc.geometry.rig",
    "StereoSequence": "topoloc.recordings.frame",
    "StreamedPose": "topoloc.tracking.stream_result",
    "Tile": "topoloc.atlas.manifest",
    "TileFetcher": "topoloc.atlas.tile_fetcher",
    "TopoMetricMap": "topoloc.mapping.topomap",
    "TopoNode": "topoloc.mapping.storage.entries",
    "TopolocError": "topoloc.errors",
    "Trace": "topoloc.localization.search",
    "Tracker": "topoloc.tracking.tracker",
    "TrackerConfig": "topoloc.tracking.config",
    "Trajectory": "topoloc.recordings.trajectory",
    "TrajectoryError": "topoloc.errors",
    "TriedProposal": "topoloc.localization.search",
    "UncalibratedCamera": "topoloc.geometry.uncalibrated_camera",
    "UnreadableImageError": "topoloc.errors",
    "WeakRegion": "topoloc.lifelong.weak_regions",
    "WeakRegions": "topoloc.lifelong.weak_regions",
    "WeightsError": "topoloc.errors",
    "WorldFit": "topoloc.evaluation.world_alignment",
    "align_to_trajectory": "topoloc.recordings.trajectory_alignment",
    "build_map": "topoloc.localization.map_facts.map_building",
    "check_camera_calibrations": "topoloc.localization.image_calibration_check",
    "check_map": "topoloc.localization.map_facts.contradictions",
    "evaluate": "topoloc.evaluation.query_localization",
    "explain": "topoloc.apps.report.explanation",
    "export": "topoloc.apps.export.formats",
    "find_frames_with_truth": "topoloc.evaluation.query_localization",
    "find_tile_of_recording": "topoloc.lifelong.tiles.tile_joining",
    "find_weak_regions": "topoloc.lifelong.weak_regions",
    "georeference": "topoloc.mapping.georeference",
    "join_tiles": "topoloc.lifelong.tiles.tile_joining",
    "localize_out_of_map": "topoloc.evaluation.query_localization",
    "localize_queries": "topoloc.evaluation.query_localization",
    "merge": "topoloc.lifelong.merge",
    "open_place": "topoloc.atlas.place",
    "open_sequence": "topoloc.recordings.open",
    "prune": "topoloc.lifelong.prune",
    "read_depth": "topoloc.recordings.image_io",
    "read_history": "topoloc.mapping.edit",
    "read_image": "topoloc.recordings.image_io",
    "result_from_json": "topoloc.localization.result",
    "run_slam": "topoloc.slam.slam",
    "set_num_threads": "topoloc.compiled",
    "undo_edit": "topoloc.mapping.edit",
    "update": "topoloc.lifelong.update",
    "view": "topoloc.apps.viewer.page",
    "warm_up": "topoloc.tracking.warm_up",
    "with_pose_conventions": "topoloc.recordings.trajectory",
    "with_trajectory": "topoloc.recordings.trajectory",
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("topoloc")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return list(__all__)
