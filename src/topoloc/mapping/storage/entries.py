"""Define the entries of a map as data: nodes with their points, mapping images, and virtual
nodes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar, no_type_check

import numpy as np
from jaxtyping import Float, Float32, Int8, UInt8

from topoloc.features.feature_types import find_feature_type
from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.json_data import OneLine
from topoloc.mapping.landmark_statistics import LandmarkStatistics
from topoloc.node_ids import LazySequence, NodeId
from topoloc.retrieval.coarse import CoarseModel

K = TypeVar("K")
T = TypeVar("T")


def overlay(base: Sequence[T], changed: Mapping[int, T], added: Sequence[T]) -> LazySequence[T]:
    """Return `base` with the entries of `changed` (by row) replaced and those of `added`
    appended."""

    def read(row: int) -> T:
        if row in changed:
            return changed[row]
        return base[row] if row < len(base) else added[row - len(base)]

    return LazySequence(lambda: len(base) + len(added), read)


def change_each(entries: Sequence[K], change: Callable[[K], T]) -> LazySequence[T]:
    """Return the entries, each changed at every access."""
    return LazySequence(partial(len, entries), lambda row: change(entries[row]))


class LazyMapping(Mapping[K, T]):
    """Show a mapping whose values are read at every access: `read` of the entries of `keys()`."""

    def __init__(self, keys: Callable[[], Mapping[K, Any]], read: Callable[[Any], T]) -> None:
        self._keys, self._read = keys, read

    def __len__(self) -> int:
        return len(self._keys())

    def __iter__(self) -> Iterator[K]:
        return iter(self._keys())

    def __getitem__(self, key: K) -> T:
        return self._read(self._keys()[key])


@dataclass(frozen=True, eq=False)
class NodeSummary:
    """Hold the properties of a node without its points.

    `node_id` never changes and is never reused. It is not the node's row (`TopoMetricMap.row_of`).
    `recording` is the name of the session `session_id`. Two sessions may have the same name.
    `of_node` is the id of the node that a virtual node belongs to.
    """

    node_id: NodeId
    recording: str
    name: str
    t_ns: int
    world_from_cam: Rigid3
    num_points: int
    session_id: int = 0
    of_node: NodeId | None = None


@dataclass(frozen=True, eq=False, repr=False)
class TopoNode(OneLine):
    """One topological node: "a single template node image, its global SE(3) pose and a point cloud
    comprising of 2D SURF features and their 3D positions".

    - `features.points_img` are pixels of `camera` (of a stereo pair: the rectified left one).
    - Row k of `points_cam` (metres, the node's camera frame) is the position of feature k.
    - Row k of `point_sqrt_covs` holds the lower triangular L (xx, yx, yy, zx, zy, zz, in metres) of
      its covariance ``L @ L.T``.
    - `template_image` is the node's encoded image, possibly smaller than `camera`.
    - `session_statistics` are each session's statistics of the points, if kept.
    - `stored_descriptors` are the descriptors of the file, so that saving writes the same ones.
    """

    summary: NodeSummary
    camera: Camera
    features: Features
    points_cam: Float32[np.ndarray, "n 3"]
    point_sqrt_covs: Float32[np.ndarray, "n 6"]
    template_image: bytes
    session_statistics: Iterable[LandmarkStatistics] = ()
    stored_descriptors: Int8[np.ndarray, "n d"] | None = None

    def read_image(self) -> UInt8[np.ndarray, "h w *rgb"] | None:
        """Return the node's stored image, grey (H, W) or RGB (H, W, 3). None if it has none.

        Raises:
            MapError: the image is damaged, or larger than the images of the node's camera.
        """
        from topoloc.recordings.stored_images import read_stored_image  # it needs OpenCV

        if not self.template_image:
            return None
        size = self.camera.width, self.camera.height
        return read_stored_image(f"node {self.summary.node_id}", self.template_image, size)


@dataclass(frozen=True, eq=False)
class PlaceImage:
    """A mapping image, labelled with its nearest node by Eq. 1, to train the coarse localizers.

    The image is small and encoded (`jpeg`). `image_id` never changes and is never reused. It is
    None until the map is saved.
    """

    recording: str
    name: str
    node_id: NodeId
    world_from_cam: Rigid3
    jpeg: bytes
    session_id: int = 0
    image_id: int | None = None


@no_type_check  # a type check at run time would read entries from the file
@dataclass(frozen=True, eq=False)
class VirtualNodes:
    """Hold nodes of virtual cameras that look to the left and right of mapping cameras
    (`virtual_nodes.py`).

    Their features have one type, `kind`. `summaries[i]` and `nodes[i]` describe virtual node i. It
    has the session, name and time of the node `of_node`, the pose of the virtual camera, and no
    template. The one model of `coarse_models` retrieves virtual nodes. Its array `centres` (n, 3)
    holds the median world point (metres) of each.
    """

    summaries: Sequence[NodeSummary]
    nodes: Sequence[TopoNode]
    coarse_models: Mapping[str, CoarseModel]
    kind: str

    def is_used_with(self, kind: str) -> bool:
        """Return whether the virtual nodes are queried together with the nodes' points of this
        feature type."""
        return self.kind in (kind, find_feature_type(kind).virtual_view_type)


@dataclass(frozen=True, order=True)
class Edge:
    """A transition of the camera from node `source_id` to node `target_id`."""

    source_id: NodeId
    target_id: NodeId


@no_type_check  # as for virtual nodes
@dataclass(frozen=True, eq=False)
class Repetitions:
    """Hold the repetitions of the map's content, as `map_facts/repetition.py` finds them.

    `moves` holds transforms (4x4 matrices, world) by node id. Each maps the content of a node to
    another place of the map. Nodes without repetitions are left out. `digest` identifies the set of
    examined nodes. The result holds only for these.
    """

    digest: str
    moves: Mapping[NodeId, Float[np.ndarray, "k 4 4"]]


@dataclass(frozen=True)
class CorrelatedErrors:
    """Hold rho, the correlated error share: the part of a match's variance that the map's points
    share.

    `map_facts/correlated_errors.py` measures it. `digest` identifies the nodes and settings. The
    result holds only for these.
    """

    rho: float
    digest: str


@dataclass(frozen=True)
class NextIds:
    """Hold the ids of the next new entries. They are larger than any id ever used in the map."""

    session: int = 0
    node: int = 0
    place_image: int = 1
    side_node: int = 0
    edit: int = 1


@no_type_check  # as for virtual nodes
@dataclass(frozen=True, eq=False)
class Layer:
    """Hold the part of a map that belongs to one feature type.

    - `nodes[i]` is the node of row i with its points of this type.
    - `coarse_models` holds coarse localizers by name. Those that need no local features stand in
      the first layer only.
    - `shared_errors` is None if not measured.
    """

    nodes: Sequence[TopoNode]
    coarse_models: Mapping[str, CoarseModel] = field(default_factory=dict)
    shared_errors: CorrelatedErrors | None = None
