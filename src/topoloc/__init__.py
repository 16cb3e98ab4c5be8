"""topoloc: a place mapped once with a stereo or RGB-D camera; afterwards any single image of it
gets a metric 6-DoF pose.

The public names; each loads its module when it is first asked for, so that `import topoloc` costs
nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from topoloc.apps.service.client import AsyncClient, Client
    from topoloc.atlas.atlas import Atlas
    from topoloc.atlas.atlas_localizer import AtlasLocalizer
    from topoloc.atlas.config import AtlasConfig
    from topoloc.atlas.editing import NewTile, add_tiles, read_manifest
    from topoloc.atlas.location_prior import GeoPositionPrior
    from topoloc.atlas.manifest import Tile
    from topoloc.atlas.map_cache import MapCache
    from topoloc.atlas.shared_world import SharedWorld
    from topoloc.compiled import set_num_threads
    from topoloc.errors import (
        AtlasError,
        CalibrationError,
        ClusterError,
        ConfigError,
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
    from topoloc.geometry.camera import Camera
    from topoloc.geometry.geodesy import GeoPose, Georeference
    from topoloc.geometry.pose_conventions import PoseConventions
    from topoloc.geometry.rig import StereoRig
    from topoloc.geometry.rigid import Rigid3
    from topoloc.geometry.uncalibrated_camera import UncalibratedCamera
    from topoloc.lifelong.weak_regions import NodeQuality, WeakRegion, WeakRegions
    from topoloc.localization.localizer import Localizer, LocalizerConfig
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
    from topoloc.mapping.description import describe_map
    from topoloc.mapping.entries import TopoNode
    from topoloc.mapping.sessions import Illumination
    from topoloc.mapping.topomap import TopoMetricMap
    from topoloc.recordings.frame import DepthImage, Image, StereoFrame, StereoSequence
    from topoloc.recordings.image_io import read_depth, read_image
    from topoloc.recordings.memory_sequence import MemorySequence
    from topoloc.recordings.open import open_sequence
    from topoloc.recordings.trajectory import Trajectory, read_trajectory, tum_text
    from topoloc.recordings.trajectory_alignment import align_to_trajectory
    from topoloc.tracking.stream_result import StreamedPose
    from topoloc.tracking.tracker import Tracker, TrackerConfig
    from topoloc.tracking.warm_up import warm_up

    __version__: str

__all__ = [
    "Alternative",
    "AsyncClient",
    "Atlas",
    "AtlasConfig",
    "AtlasError",
    "AtlasLocalizer",
    "BuildConfig",
    "CalibrationError",
    "Camera",
    "Client",
    "ClusterError",
    "ConfigError",
    "DepthImage",
    "EvaluatedQuery",
    "GeoPose",
    "GeoPositionPrior",
    "Georeference",
    "GeoreferenceError",
    "Illumination",
    "Image",
    "Localization",
    "Localizer",
    "LocalizerConfig",
    "MapCache",
    "MapError",
    "MapNotFoundError",
    "MemorySequence",
    "MissingExtraError",
    "NewTile",
    "NodeQuality",
    "NotLocalized",
    "ObjectStoreError",
    "PoseConventions",
    "Provenance",
    "QueryError",
    "RecordingError",
    "ResultError",
    "Rigid3",
    "ServiceError",
    "SharedWorld",
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
    "__version__",
    "add_tiles",
    "align_to_trajectory",
    "build_map",
    "describe_map",
    "open_sequence",
    "read_depth",
    "read_image",
    "read_manifest",
    "read_trajectory",
    "result_from_json",
    "set_num_threads",
    "tum_text",
    "warm_up",
]

_MODULES = {
    "Alternative": "topoloc.localization.result",
    "AsyncClient": "topoloc.apps.service.client",
    "Atlas": "topoloc.atlas.atlas",
    "AtlasConfig": "topoloc.atlas.config",
    "AtlasError": "topoloc.errors",
    "AtlasLocalizer": "topoloc.atlas.atlas_localizer",
    "BuildConfig": "topoloc.mapping.build",
    "CalibrationError": "topoloc.errors",
    "Camera": "topoloc.geometry.camera",
    "Client": "topoloc.apps.service.client",
    "ClusterError": "topoloc.errors",
    "ConfigError": "topoloc.errors",
    "DepthImage": "topoloc.recordings.frame",
    "EvaluatedQuery": "topoloc.evaluation.metrics",
    "GeoPose": "topoloc.geometry.geodesy",
    "GeoPositionPrior": "topoloc.atlas.location_prior",
    "Georeference": "topoloc.geometry.geodesy",
    "GeoreferenceError": "topoloc.errors",
    "Illumination": "topoloc.mapping.sessions",
    "Image": "topoloc.recordings.frame",
    "Localization": "topoloc.localization.result",
    "Localizer": "topoloc.localization.localizer",
    "LocalizerConfig": "topoloc.localization.localizer",
    "MapCache": "topoloc.atlas.map_cache",
    "MapError": "topoloc.errors",
    "MapNotFoundError": "topoloc.errors",
    "MemorySequence": "topoloc.recordings.memory_sequence",
    "MissingExtraError": "topoloc.errors",
    "NewTile": "topoloc.atlas.editing",
    "NodeQuality": "topoloc.lifelong.weak_regions",
    "NotLocalized": "topoloc.localization.result",
    "ObjectStoreError": "topoloc.errors",
    "PoseConventions": "topoloc.geometry.pose_conventions",
    "Provenance": "topoloc.localization.provenance",
    "QueryError": "topoloc.errors",
    "RecordingError": "topoloc.errors",
    "ResultError": "topoloc.errors",
    "Rigid3": "topoloc.geometry.rigid",
    "ServiceError": "topoloc.errors",
    "SharedWorld": "topoloc.atlas.shared_world",
    "StereoFrame": "topoloc.recordings.frame",
    "StereoRig": "topoloc.geometry.rig",
    "StereoSequence": "topoloc.recordings.frame",
    "StreamedPose": "topoloc.tracking.stream_result",
    "Tile": "topoloc.atlas.manifest",
    "TopoMetricMap": "topoloc.mapping.topomap",
    "TopoNode": "topoloc.mapping.entries",
    "TopolocError": "topoloc.errors",
    "Trace": "topoloc.localization.search",
    "Tracker": "topoloc.tracking.tracker",
    "TrackerConfig": "topoloc.tracking.tracker",
    "Trajectory": "topoloc.recordings.trajectory",
    "TrajectoryError": "topoloc.errors",
    "TriedProposal": "topoloc.localization.search",
    "UncalibratedCamera": "topoloc.geometry.uncalibrated_camera",
    "UnreadableImageError": "topoloc.errors",
    "WeakRegion": "topoloc.lifelong.weak_regions",
    "WeakRegions": "topoloc.lifelong.weak_regions",
    "WeightsError": "topoloc.errors",
    "add_tiles": "topoloc.atlas.editing",
    "align_to_trajectory": "topoloc.recordings.trajectory_alignment",
    "build_map": "topoloc.localization.map_facts.map_building",
    "describe_map": "topoloc.mapping.description",
    "open_sequence": "topoloc.recordings.open",
    "read_depth": "topoloc.recordings.image_io",
    "read_image": "topoloc.recordings.image_io",
    "read_manifest": "topoloc.atlas.editing",
    "read_trajectory": "topoloc.recordings.trajectory",
    "result_from_json": "topoloc.localization.result",
    "set_num_threads": "topoloc.compiled",
    "tum_text": "topoloc.recordings.trajectory",
    "warm_up": "topoloc.tracking.warm_up",
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
