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
    from topoloc.compiled import set_num_threads
    from topoloc.errors import TopolocError
    from topoloc.geometry.camera import Camera
    from topoloc.geometry.geodesy import GeoPose
    from topoloc.geometry.rig import StereoRig
    from topoloc.geometry.rigid import Rigid3
    from topoloc.localization.localizer import Localizer, LocalizerConfig
    from topoloc.localization.map_facts.map_building import build_map
    from topoloc.localization.provenance import Provenance
    from topoloc.localization.result import Alternative, Localization, NotLocalized
    from topoloc.localization.search import Trace
    from topoloc.mapping.build import BuildConfig
    from topoloc.mapping.topomap import TopoMetricMap
    from topoloc.recordings.frame import DepthImage, StereoFrame
    from topoloc.recordings.memory_sequence import MemorySequence
    from topoloc.recordings.open import open_sequence
    from topoloc.tracking.stream_result import StreamedPose
    from topoloc.tracking.tracker import Tracker, TrackerConfig
    from topoloc.tracking.warm_up import warm_up

    __version__: str

__all__ = [
    "Alternative",
    "AsyncClient",
    "BuildConfig",
    "Camera",
    "Client",
    "DepthImage",
    "GeoPose",
    "Localization",
    "Localizer",
    "LocalizerConfig",
    "MemorySequence",
    "NotLocalized",
    "Provenance",
    "Rigid3",
    "StereoFrame",
    "StereoRig",
    "StreamedPose",
    "TopoMetricMap",
    "TopolocError",
    "Trace",
    "Tracker",
    "TrackerConfig",
    "__version__",
    "build_map",
    "open_sequence",
    "set_num_threads",
    "warm_up",
]

_MODULES = {
    "Alternative": "topoloc.localization.result",
    "AsyncClient": "topoloc.apps.service.client",
    "BuildConfig": "topoloc.mapping.build",
    "Camera": "topoloc.geometry.camera",
    "Client": "topoloc.apps.service.client",
    "DepthImage": "topoloc.recordings.frame",
    "GeoPose": "topoloc.geometry.geodesy",
    "Localization": "topoloc.localization.result",
    "Localizer": "topoloc.localization.localizer",
    "LocalizerConfig": "topoloc.localization.localizer",
    "MemorySequence": "topoloc.recordings.memory_sequence",
    "NotLocalized": "topoloc.localization.result",
    "Provenance": "topoloc.localization.provenance",
    "Rigid3": "topoloc.geometry.rigid",
    "StereoFrame": "topoloc.recordings.frame",
    "StereoRig": "topoloc.geometry.rig",
    "StreamedPose": "topoloc.tracking.stream_result",
    "TopoMetricMap": "topoloc.mapping.topomap",
    "TopolocError": "topoloc.errors",
    "Trace": "topoloc.localization.search",
    "Tracker": "topoloc.tracking.tracker",
    "TrackerConfig": "topoloc.tracking.tracker",
    "build_map": "topoloc.localization.map_facts.map_building",
    "open_sequence": "topoloc.recordings.open",
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
