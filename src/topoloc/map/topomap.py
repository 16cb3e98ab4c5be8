"""The topo-metric map of the paper (section III-A): nodes with features and their 3-D positions, edges, place images.

Data only: `build.py` makes it, `storage.py` writes and `stored_map.py` reads it, `localization` asks it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from topoloc.errors import MapError
from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.places.coarse import CoarseLocalizer, CoarseModel, open_coarse


@dataclass(frozen=True, eq=False)
class NodeSummary:
    """What is known of a node without reading its points: where it stands and where it comes from."""

    node_id: int
    recording: str
    name: str
    t_ns: int
    world_from_cam: Rigid3
    num_points: int


@dataclass(frozen=True, eq=False)
class TopoNode:
    """One topological node: "a single template node image, its global SE(3) pose and a point cloud
    comprising of 2D SURF features and their 3D positions".

    `features.points_img` are pixels of `camera` (of a stereo pair: the rectified left one); row k of `points_cam` (metres,
    the node's camera frame) is the position of feature k, with covariance ``L @ L.T`` for the lower triangular L in row k
    of `point_sqrt_covs` (xx, yx, yy, zx, zy, zz; metres). `template_jpeg` is the node's picture, encoded, possibly smaller than `camera`.
    """

    summary: NodeSummary
    camera: Camera
    features: Features
    points_cam: Float32[np.ndarray, "n 3"]
    point_sqrt_covs: Float32[np.ndarray, "n 6"]
    template_jpeg: bytes


@dataclass(frozen=True, eq=False)
class PlaceImage:
    """A mapping image labelled with the node it belongs to (nearest by Eq. 1): what the coarse localizers learn from.

    The picture is small and encoded (`jpeg`).
    """

    recording: str
    name: str
    node_id: int
    world_from_cam: Rigid3
    jpeg: bytes


@dataclass(frozen=True, eq=False)
class SideNodes:
    """Nodes seen once more by cameras turned to the left and to the right (`side_nodes.py`).

    `summaries[i]` and `nodes[i]` describe side node i: recording, name and time are those of the node whose picture it comes
    from, the pose is that of the side camera, and there is no template. The one model of `coarse_models` ranks side nodes by
    looks; its array `centres` (n, 3) holds the world points (metres) in the middle of what each of them shows.
    """

    summaries: Sequence[NodeSummary]
    nodes: Sequence[TopoNode]
    coarse_models: Mapping[str, CoarseModel]


@dataclass(frozen=True)
class Edge:
    """The robot went from node `source_id` to node `target_id`."""

    source_id: int
    target_id: int


@dataclass(frozen=True)
class SharedErrors:
    """rho, the share of a match's variance that the map's points have in common, as `localization/correlated_errors.py` measured it.

    `digest` stands for the nodes and the settings that it was measured of and with: of others it says nothing.
    """

    rho: float
    digest: str


@dataclass(frozen=True, eq=False)
class TopoMetricMap:
    """The map. In a map that was loaded, every sequence and mapping reads the file only when an entry is asked for.

    `summaries[i]` describes `nodes[i]`, and ``nodes[i].summary.node_id == i``. `config` is the effective configuration it
    was built with, `length_m` the metres of trajectory that were mapped. `default_coarse` names the coarse localizer that answers
    where the user names none. `shared_errors` is None where nobody has measured them,
    `sides` where no mapping picture is wide enough to show the walls along the way.
    """

    summaries: Sequence[NodeSummary]
    nodes: Sequence[TopoNode]
    edges: Sequence[Edge]
    place_images: Sequence[PlaceImage]
    coarse_models: Mapping[str, CoarseModel]
    config: Mapping[str, Any] = field(default_factory=dict)
    length_m: float = 0.0
    default_coarse: str = "surf-vlad"
    shared_errors: SharedErrors | None = None
    sides: SideNodes | None = None

    def save(self, path: str | Path) -> None:
        """Write the map file at once or not at all. Raises MapError."""
        from topoloc.map.storage import save_map

        save_map(self, Path(path))

    @staticmethod
    def load(path: str | Path) -> TopoMetricMap:
        """Open a map file; nodes are read when asked for. Raises MapError, MapVersionError."""
        from topoloc.map.stored_map import open_map

        return open_map(Path(path))


def open_coarse_of(topomap: TopoMetricMap, name: str) -> CoarseLocalizer:
    """A map's coarse localizer. Raises MapError where the map has none of this name."""
    if name not in topomap.coarse_models:
        available = ", ".join(topomap.coarse_models) or "none"
        raise MapError(f"the map has no coarse localizer {name!r} (it has: {available})")
    return open_coarse(topomap.coarse_models[name])
