"""Define the entries of a map as data: nodes with their points, mapping images, virtual nodes,
sessions and edits."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass, field
from datetime import UTC, datetime
from functools import partial
from typing import Any, TypeVar, no_type_check

import numpy as np
from jaxtyping import Float, Float32, Int8, UInt8

from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.json_data import NonNegative, OneLine
from topoloc.mapping.landmark_statistics import LandmarkStatistics
from topoloc.node_ids import LazySequence, NodeId
from topoloc.retrieval.coarse import CoarseModel, Image

_YEAR_2000_NS = 946_684_800 * 1_000_000_000
"""Earlier times belong to clocks that start at 0 and have no date."""


@dataclass(frozen=True)
class Illumination:
    """Hold the illumination of a session, averaged over its images. Grey levels are 0 to 1.

    `level` is the mean grey level, `contrast` the standard deviation of grey levels within an
    image. `dark` and `bright` are the shares of pixels below 1/16 and above 15/16. `red` and `blue`
    are the mean levels of these colours divided by green, 1 in grey images.
    """

    level: float
    contrast: float
    dark: float
    bright: float
    red: float
    blue: float

    @staticmethod
    def of_image(image: Image) -> Illumination:
        """Measure the illumination of an image (uint8) on every fourth pixel in each direction."""
        sample = image[::4, ::4].astype(np.float64) / 255.0
        grey, colours = sample, np.ones(3)
        if sample.ndim == 3:
            grey = sample @ np.array([0.299, 0.587, 0.114])
            colours = sample.reshape(-1, 3).mean(axis=0) + 1e-3
        red, blue = colours[0] / colours[1], colours[2] / colours[1]
        parts = grey.mean(), grey.std(), (grey < 1 / 16).mean(), (grey > 15 / 16).mean(), red, blue
        return Illumination(*map(float, parts))


@dataclass(frozen=True)
class Session:
    """Hold one recording of the map.

    `session_id` never changes and is never reused. Two sessions may have the same name. `recording`
    is the folder or file, if known. `poses_from` is `truth`, `slam`, `map`, the name of a
    trajectory file, or `given` if the caller provided the poses. Times are those of the first and
    last mapping image, in nanoseconds of the recording's clock. `camera` is that of its images
    before rectification. `light` is measured, and `light_name` is set by the user.
    """

    session_id: int
    name: str
    recording: str | None = None
    poses_from: str = "given"
    start_ns: int | None = None
    end_ns: int | None = None
    camera: Camera | None = None
    light: Illumination | None = None
    light_name: str | None = None

    @property
    def start_date(self) -> str | None:
        """Return the ISO date and time (UTC) of the first mapping image, or None if the recording's
        clock has no date."""
        return _format_date(self.start_ns)

    @property
    def end_date(self) -> str | None:
        """Return the ISO date and time (UTC) of the last mapping image, or None as `start_date`."""
        return _format_date(self.end_ns)


@dataclass(frozen=True)
class Edit:
    """Hold one edit of the map.

    This is: its name, its day (ISO, UTC), the schema of the file it was written in, and its changes
    (numbers and texts by name).
    """

    edit_id: int
    name: str
    date: str
    schema: int
    changes: Mapping[str, Any] | None = None


def today() -> str:
    """Return the day (ISO, UTC). SOURCE_DATE_EPOCH (seconds) replaces the current time if set, for
    byte-identical builds. One that is no time counts as not set."""
    now = datetime.now(UTC)
    with suppress(ValueError, OverflowError, OSError):
        now = datetime.fromtimestamp(int(os.environ.get("SOURCE_DATE_EPOCH", "")), UTC)
    return now.date().isoformat()


def average_illumination(lights: Sequence[Illumination]) -> Illumination | None:
    """Return the mean illumination, rounded to four decimals, or None if `lights` is empty."""
    if not lights:
        return None
    rows = np.array([astuple(light) for light in lights])
    return Illumination(*(round(float(value), 4) for value in rows.mean(axis=0)))


def _format_date(t_ns: int | None) -> str | None:
    if t_ns is None or t_ns < _YEAR_2000_NS:
        return None
    try:
        return datetime.fromtimestamp(t_ns / 1e9, UTC).isoformat(timespec="seconds")
    except (OverflowError, ValueError, OSError):
        return None


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
    - `template` is the node's encoded image, possibly smaller than `camera`, or reads it.
    - `session_statistics` are each session's statistics of the points, if kept.
    - `stored_descriptors` are the descriptors of the file, so that saving writes the same ones.
    """

    summary: NodeSummary
    camera: Camera
    features: Features
    points_cam: Float32[np.ndarray, "n 3"]
    point_sqrt_covs: Float32[np.ndarray, "n 6"]
    template: bytes | Callable[[], bytes]
    session_statistics: Iterable[LandmarkStatistics] = ()
    stored_descriptors: Int8[np.ndarray, "n d"] | None = None

    @property
    def template_image(self) -> bytes:
        """Return the node's encoded image, empty if it has none. Raises MapError: it cannot be
        read."""
        return self.template if isinstance(self.template, bytes) else self.template()

    def read_image(self) -> UInt8[np.ndarray, "h w *rgb"] | None:
        """Return the node's stored image, grey (H, W) or RGB (H, W, 3). None if it has none.

        Raises:
            MapError: the image is damaged, or larger than the images of the node's camera.
        """
        from topoloc.recordings.stored_images import read_stored_image  # it needs OpenCV

        image, size = self.template_image, (self.camera.width, self.camera.height)
        return read_stored_image(f"node {self.summary.node_id}", image, size) if image else None


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
    (`node_drafts.py`).

    Their features have one type, `kind`. `summaries[i]` and `nodes[i]` describe virtual node i. It
    has the session, name and time of the node `of_node`, the pose of the virtual camera, and no
    template. The one model of `coarse_models` retrieves virtual nodes. Its array `centres` (n, 3)
    holds the median world point (metres) of each.
    """

    summaries: Sequence[NodeSummary]
    nodes: Sequence[TopoNode]
    coarse_models: Mapping[str, CoarseModel]
    kind: str


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

    rho: NonNegative
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
