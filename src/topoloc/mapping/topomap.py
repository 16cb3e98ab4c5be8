"""Define the topo-metric map (section III-A of the paper): nodes with features and 3-D positions,
edges, place images.

`build.py` creates it, `map_writing.py` writes it, `map_reading.py` reads it, and `localization`
uses it.

Every entry has an id that never changes and is never reused. Computations use rows: row i is
`summaries[i]` and `nodes[i]`. `row_of` converts an id to a row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, no_type_check

import numpy as np

from topoloc.errors import FeatureTypeError, MapError
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.contents import Layer, MapContents, get_map_id
from topoloc.mapping.entries import (
    CorrelatedErrors,
    Edge,
    NodeSummary,
    PlaceImage,
    Repetitions,
    TopoNode,
    VirtualNodes,
)
from topoloc.mapping.map_file import MapFile
from topoloc.mapping.map_reading import open_map
from topoloc.mapping.map_writing import save_map
from topoloc.mapping.nodes import NodePoses, node_distances
from topoloc.mapping.schema import SCHEMA_VERSION
from topoloc.mapping.session_illumination import find_node_illumination_groups
from topoloc.mapping.sessions import Edit, Session
from topoloc.node_ids import NodeId, Row, as_rows
from topoloc.retrieval.coarse import (
    CoarseLocalizer,
    CoarseModel,
    DescriptorLocalizer,
    open_coarse_localizer,
)

__all__ = [
    "CorrelatedErrors",
    "Edge",
    "Edit",
    "Layer",
    "NodeSummary",
    "PlaceImage",
    "Repetitions",
    "Session",
    "TopoMetricMap",
    "TopoNode",
    "VirtualNodes",
    "open_map_coarse_localizer",
]


@no_type_check  # as for MapContents
@dataclass(frozen=True, eq=False)
class TopoMetricMap(MapContents):
    """A topo-metric map, see `MapContents` for its fields.

    The sequences and mappings of a loaded map read the file when an entry is accessed. A loaded map
    keeps its file open until `close` or the end of ``with TopoMetricMap.load(path) as topomap``. It
    is pickled as its path. Several threads may read it.
    """

    schema_version: ClassVar[int] = SCHEMA_VERSION
    """Schema of the map files that `save` writes."""

    def describe(self, path: str | Path) -> dict[str, Any]:
        """Return the facts of a map that is stored at `path` as JSON: counts, bytes, metres,
        sessions, edits, configuration. Raises EmptyMapError: the map has no node."""
        from topoloc.mapping.description import describe_map

        return describe_map(self, Path(path))

    @property
    def resolved_id(self) -> str:
        """The map's identifier, 16 hexadecimal digits, also of a map without a stored one."""
        return get_map_id(self)

    def row_of(self, node_id: NodeId) -> Row:
        """Return the row of a node. Raises KeyError if the map has no node with this id."""
        return self._rows[node_id]

    @property
    def rows(self) -> list[Row]:
        """Return the rows of all nodes."""
        return as_rows(range(len(self.summaries)))

    @cached_property
    def node_poses(self) -> NodePoses:
        """Return the poses of all nodes as arrays."""
        return NodePoses.of([summary.world_from_cam for summary in self.summaries])

    def find_neighbours(self, poses: list[Rigid3], max_neighbours: int) -> list[list[int]]:
        """Return for each of these poses the nearest others of them, by the distance of Eq. 1.

        Entries are positions in `poses`, the nearest first.
        """
        stacked, neighbours = NodePoses.of(poses), list[list[int]]()
        for k, pose in enumerate(poses):
            distances = node_distances(pose, stacked, self.config.lambda_rot)
            order = np.argsort(distances, kind="stable")[: max_neighbours + 1]
            neighbours.append([int(other) for other in order if other != k])
        return neighbours

    @cached_property
    def _rows(self) -> dict[NodeId, Row]:
        return {summary.node_id: Row(row) for row, summary in enumerate(self.summaries)}

    def find_layer(self, kind: str) -> Layer:
        """Return the layer of a feature type. Raises FeatureTypeError if the map has none."""
        if kind not in self.layers:
            raise FeatureTypeError(
                f"the map holds no features {kind} (it holds: {', '.join(self.kinds)})"
            )
        return self.layers[kind]

    def with_first_layer(self, **changes: Any) -> TopoMetricMap:
        """Return the map with fields of its first layer changed."""
        first = replace(self.first_layer, **changes)
        return replace(self, layers={**self.layers, self.kind: first})

    def save(self, path: str | Path) -> None:
        """Write the map file atomically. Raises MapError."""
        save_map(self, Path(path))

    @staticmethod
    def load(path: str | Path) -> TopoMetricMap:
        """Open a map file. Nodes are read when accessed. Raises MapError, MapVersionError."""
        return _wrap_contents(open_map(Path(path)))

    def close(self) -> None:
        """Close the file if the map was loaded. Later reads raise MapError."""
        if self.file is not None:
            self.file.close()

    def __enter__(self) -> TopoMetricMap:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def file(self) -> MapFile | None:
        """Return the file of a loaded, unchanged map. It is None for a copy changed by
        `dataclasses.replace`."""
        return self.__dict__.get("_opened")

    def __reduce__(self) -> Any:
        if self.file is None:
            return super().__reduce__()
        return _reload_map, (str(self.file.path.absolute()), self.file.digest)


def _reload_map(path: str, digest: str) -> TopoMetricMap:
    """Open the map of a pickle. Raises MapError if the file was replaced."""
    return _wrap_contents(open_map(Path(path), digest))


def _wrap_contents(read: tuple[MapContents, MapFile]) -> TopoMetricMap:
    contents, file = read
    topomap = TopoMetricMap(**vars(contents))
    topomap.__dict__["_opened"] = file  # not a field, so that a changed copy has no file
    return topomap


def open_map_coarse_localizer(
    topomap: TopoMetricMap, name: str, kind: str | None = None
) -> CoarseLocalizer:
    """Open a map's coarse localizer for a feature type, by default the first. It identifies nodes
    by row.

    If the sessions have several illuminations, descriptor localizers reduce the weight of
    differences between these.

    Raises:
        MapError: the map has no localizer of this name, or it is damaged.
    """
    own, first = (topomap.layers[one].coarse_models for one in (kind or topomap.kind, topomap.kind))
    model = own.get(name) or first.get(name)
    if model is None:
        available = ", ".join(first) or "none"
        raise MapError(f"the map has no coarse localizer {name!r} (it has: {available})")
    coarse = open_coarse_localizer(
        node_ids_to_rows(model, [summary.node_id for summary in topomap.summaries])
    )
    lights = (
        find_node_illumination_groups(topomap.summaries, topomap.sessions)
        if len(topomap.sessions) > 1
        else None
    )
    return (
        coarse.suppress_group_differences(lights)
        if isinstance(coarse, DescriptorLocalizer) and lights is not None and lights.any()
        else coarse
    )


def node_ids_to_rows(model: CoarseModel, ids: Sequence[NodeId]) -> CoarseModel:
    """Return a stored model with the ids of its nodes replaced by rows. Descriptors of other nodes
    are removed."""
    known = model.arrays.get("node_ids", _output_node_ids(model))
    if known is None or known.ndim != 1 or known.dtype.kind not in "iu":
        return model  # opening the model reports the error
    if list(ids) == list(range(len(ids))) and (
        len(known) == 0 or 0 <= known.min() <= known.max() < len(ids)
    ):
        return model
    rows: dict[int, int] = {node_id: row for row, node_id in enumerate(ids)}
    of_known = np.array([rows.get(int(node_id), -1) for node_id in known], np.int64)
    if "vectors" not in model.arrays:  # one output per node
        return replace(model, arrays={**model.arrays, "node_ids": of_known})
    kept = of_known >= 0
    if not kept.any():
        raise MapError(f"the map's coarse localizer {model.name!r} knows none of its nodes")
    per_vector = {
        name: model.arrays[name][kept]
        for name in ("vectors", "centres", "cell_vectors")
        if len(model.arrays.get(name, ())) == len(kept)
    }
    return replace(model, arrays={**model.arrays, **per_vector, "node_ids": of_known[kept]})


def _output_node_ids(model: CoarseModel) -> np.ndarray | None:
    """Return the node ids of a model with one output per node, in the order of ids."""
    num_nodes = model.settings.get("num_nodes")
    return (
        np.arange(num_nodes) if isinstance(num_nodes, int) and 0 <= num_nodes <= 1_000_000 else None
    )
