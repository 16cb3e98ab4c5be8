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
    from topoloc.atlas.location_prior import GeoPositionPrior
    from topoloc.atlas.map_cache import MapCache
    from topoloc.atlas.shared_world import SharedWorld
    from topoloc.compiled import set_num_threads
    from topoloc.errors import (
        AtlasError,
        CalibrationError,
        ClusterError,
        GeoreferenceError,
        MapError,
        MapNotFoundError,
        MissingExtraError,
        ObjectStoreError,
        QueryError,
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
    from topoloc.recordings.frame import DepthImage, StereoFrame
    from topoloc.recordings.image_io import read_image
    from topoloc.recordings.memory_sequence import MemorySequence
    from topoloc.recordings.open import open_sequence
    from topoloc.recordings.trajectory import Trajectory, read_trajectory
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
    "DepthImage",
    "EvaluatedQuery",
    "GeoPose",
    "GeoPositionPrior",
    "Georeference",
    "GeoreferenceError",
    "Illumination",
    "Localization",
    "Localizer",
    "LocalizerConfig",
    "MapCache",
    "MapError",
    "MapNotFoundError",
    "MemorySequence",
    "MissingExtraError",
    "NodeQuality",
    "NotLocalized",
    "ObjectStoreError",
    "Provenance",
    "QueryError",
    "ResultError",
    "Rigid3",
    "ServiceError",
    "SharedWorld",
    "StereoFrame",
    "StereoRig",
    "StreamedPose",
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
    "build_map",
    "describe_map",
    "open_sequence",
    "read_image",
    "read_trajectory",
    "result_from_json",
    "set_num_threads",
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
    "DepthImage": "topoloc.recordings.frame",
    "EvaluatedQuery": "topoloc.evaluation.metrics",
    "GeoPose": "topoloc.geometry.geodesy",
    "GeoPositionPrior": "topoloc.atlas.location_prior",
    "Georeference": "topoloc.geometry.geodesy",
    "GeoreferenceError": "topoloc.errors",
    "Illumination": "topoloc.mapping.sessions",
    "Localization": "topoloc.localization.result",
    "Localizer": "topoloc.localization.localizer",
    "LocalizerConfig": "topoloc.localization.localizer",
    "MapCache": "topoloc.atlas.map_cache",
    "MapError": "topoloc.errors",
    "MapNotFoundError": "topoloc.errors",
    "MemorySequence": "topoloc.recordings.memory_sequence",
    "MissingExtraError": "topoloc.errors",
    "NodeQuality": "topoloc.lifelong.weak_regions",
    "NotLocalized": "topoloc.localization.result",
    "ObjectStoreError": "topoloc.errors",
    "Provenance": "topoloc.localization.provenance",
    "QueryError": "topoloc.errors",
    "ResultError": "topoloc.errors",
    "Rigid3": "topoloc.geometry.rigid",
    "ServiceError": "topoloc.errors",
    "SharedWorld": "topoloc.atlas.shared_world",
    "StereoFrame": "topoloc.recordings.frame",
    "StereoRig": "topoloc.geometry.rig",
    "StreamedPose": "topoloc.tracking.stream_result",
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
    "build_map": "topoloc.localization.map_facts.map_building",
    "describe_map": "topoloc.mapping.description",
    "open_sequence": "topoloc.recordings.open",
    "read_image": "topoloc.recordings.image_io",
    "read_trajectory": "topoloc.recordings.trajectory",
    "result_from_json": "topoloc.localization.result",
    "set_num_threads": "topoloc.compiled",
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
