"""What a map consists of: nodes with their points, what they were made from, and the walls beside
them. Data only."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Float32, Int8

from topoloc.features.feature_types import find_feature_type
from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.landmark_statistics import LandmarkStatistics
from topoloc.retrieval.coarse import CoarseModel


@dataclass(frozen=True, eq=False)
class NodeSummary:
    """What is known of a node without reading its points: where it stands and where it comes from.

    `node_id` never changes and is never used again; it is not the node's row
    (`TopoMetricMap.row_of`). `recording` is the name of the session `session_id`, which two
    sessions may share. `of_node` is the id of the node that a side node belongs to.
    """

    node_id: int
    recording: str
    name: str
    t_ns: int
    world_from_cam: Rigid3
    num_points: int
    session_id: int = 0
    of_node: int | None = None


@dataclass(frozen=True, eq=False)
class TopoNode:
    """One topological node: "a single template node image, its global SE(3) pose and a point cloud
    comprising of 2D SURF features and their 3D positions".

    `features.points_img` are pixels of `camera` (of a stereo pair: the rectified left one); row k
    of `points_cam` (metres, the node's camera frame) is the position of feature k, with covariance
    ``L @ L.T`` for the lower triangular L in row k of `point_sqrt_covs` (xx, yx, yy, zx, zy, zz;
    metres). `template_jpeg` is the node's picture, encoded, possibly smaller than `camera`.
    `session_statistics` are what each session knows of the points, where that was kept.
    `stored_descriptors` are the descriptors as the file has them, so that a node that was read is
    written as it was.
    """

    summary: NodeSummary
    camera: Camera
    features: Features
    points_cam: Float32[np.ndarray, "n 3"]
    point_sqrt_covs: Float32[np.ndarray, "n 6"]
    template_jpeg: bytes
    session_statistics: Iterable[LandmarkStatistics] = ()
    stored_descriptors: Int8[np.ndarray, "n d"] | None = None


@dataclass(frozen=True, eq=False)
class PlaceImage:
    """A mapping image labelled with the node it belongs to (nearest by Eq. 1): what the coarse
    localizers learn from.

    The picture is small and encoded (`jpeg`). `image_id` never changes and is never used again;
    None until the map is saved.
    """

    recording: str
    name: str
    node_id: int
    world_from_cam: Rigid3
    jpeg: bytes
    session_id: int = 0
    image_id: int | None = None


@no_type_check  # at run time: it would read from the file to look at entries' types
@dataclass(frozen=True, eq=False)
class VirtualNodes:
    """Nodes seen once more by cameras turned to the left and to the right (`virtual_nodes.py`).

    They are described by features of one `kind`. `summaries[i]` and `nodes[i]` describe side node
    i: session, name and time are those of the node `of_node` whose picture it comes from, the pose
    is that of the side camera, and there is no template. The one model of `coarse_models` ranks
    side nodes by looks; its array `centres` (n, 3) holds the world points (metres) in the middle of
    what each of them shows.
    """

    summaries: Sequence[NodeSummary]
    nodes: Sequence[TopoNode]
    coarse_models: Mapping[str, CoarseModel]
    kind: str

    def is_used_with(self, kind: str) -> bool:
        """Are they asked together with the nodes' points of this kind of features?"""
        return self.kind in (kind, find_feature_type(kind).virtual_view_type)


@dataclass(frozen=True)
class Edge:
    """The robot went from node `source_id` to node `target_id`."""

    source_id: int
    target_id: int


@no_type_check  # as of a side node's
@dataclass(frozen=True, eq=False)
class Repetitions:
    """By node id, the moves (4x4 matrices, world) by which what a node shows is found elsewhere in
    the map, of nodes that have any, as `map_facts/repetition.py` found them. `digest` stands for
    the nodes that were looked at: of others it says nothing.
    """

    digest: str
    moves: Mapping[int, Float[np.ndarray, "k 4 4"]]


@dataclass(frozen=True)
class CorrelatedErrors:
    """rho, the share of a match's variance that the map's points have in common, as
    `map_facts/correlated_errors.py` measured it.

    `digest` stands for the nodes and the settings that it was measured of and with: of others it
    says nothing.
    """

    rho: float
    digest: str
