"""The topo-metric map of the paper (section III-A): nodes with features and their 3-D positions,
edges, place images.

`build.py` makes it, `map_writing.py` writes and `map_reading.py` reads it, `localization` asks it.

Everything in a map has an id that never changes and is never used again. Whoever computes works on
rows, which the open map derives: row i is `summaries[i]` and `nodes[i]`, and `row_of` leads there
from an id.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, no_type_check

import numpy as np

from topoloc.errors import FeatureTypeError, MapError
from topoloc.mapping.contents import MapContents
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
from topoloc.mapping.session_illumination import find_node_illumination_groups
from topoloc.mapping.sessions import Edit, Session
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
    "NodeSummary",
    "PlaceImage",
    "Repetitions",
    "Session",
    "TopoMetricMap",
    "TopoNode",
    "VirtualNodes",
    "open_map_coarse_localizer",
]


@no_type_check  # as of its contents
@dataclass(frozen=True, eq=False)
class TopoMetricMap(MapContents):
    """The map, see `MapContents` for what it holds. In one that was loaded, every sequence and
    mapping reads the file only when an entry is asked for.

    A map that was loaded holds its file open; ``with TopoMetricMap.load(path) as topomap`` or
    `close` let go of it. It is pickled as its path, and several threads may read it.
    """

    def row_of(self, node_id: int) -> int:
        """The row of a node. Raises KeyError where the map has no node of this id."""
        return self._rows[node_id]

    def find_neighbours(self, rows: Sequence[int], max_neighbours: int) -> list[list[int]]:
        """Return for each of these nodes the nearest others of them, by the distance of Eq. 1.

        Entries are positions in `rows`, the nearest first.
        """
        poses = [self.summaries[row].world_from_cam for row in rows]
        stacked, neighbours = NodePoses.of(poses), list[list[int]]()
        for k, pose in enumerate(poses):
            distances = node_distances(pose, stacked, self.config.lambda_rot)
            order = np.argsort(distances, kind="stable")[: max_neighbours + 1]
            neighbours.append([int(other) for other in order if other != k])
        return neighbours

    @cached_property
    def _rows(self) -> dict[int, int]:
        return {summary.node_id: row for row, summary in enumerate(self.summaries)}

    def with_feature_type(self, kind: str) -> TopoMetricMap:
        """The map as if it were made of this one of its kinds of features alone, its walls too;
        itself by its first kind.

        Raises:
            FeatureKindError: it holds no such features.
        """
        if kind == self.kind:
            return self
        if kind not in self.other_kinds:
            raise FeatureTypeError(
                f"the map holds no features {kind} (it holds: {', '.join(self.kinds)})"
            )
        return replace(
            self,
            nodes=self.other_kinds[kind],
            config=replace(
                self.config, features=self.config.feature_config_for(kind), other_kinds=()
            ),
            shared_errors=self.other_shared_errors.get(kind),
            sides=self.sides if self.sides is not None and self.sides.is_used_with(kind) else None,
            other_kinds={},
            other_shared_errors={},
        )

    def save(self, path: str | Path) -> None:
        """Write the map file at once or not at all. Raises MapError."""
        save_map(self, Path(path))

    @staticmethod
    def load(path: str | Path) -> TopoMetricMap:
        """Open a map file; nodes are read when asked for. Raises MapError, MapVersionError."""
        return _wrap_contents(open_map(Path(path)))

    def close(self) -> None:
        """Let go of the file, where the map was loaded; what is asked of it afterwards is a
        MapError."""
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
        """Where the map comes from as it is; a changed one (`dataclasses.replace`) is no longer
        that of the file."""
        return self.__dict__.get("_opened")

    def __reduce__(self) -> Any:
        if self.file is None:
            return super().__reduce__()
        return _reload_map, (str(self.file.path.absolute()), self.file.digest)


def _reload_map(path: str, digest: str) -> TopoMetricMap:
    """The map that was pickled. Raises MapError where another one is in its place by now."""
    return _wrap_contents(open_map(Path(path), digest))


def _wrap_contents(read: tuple[MapContents, MapFile]) -> TopoMetricMap:
    contents, file = read
    topomap = TopoMetricMap(**vars(contents))
    topomap.__dict__["_opened"] = file  # no field: a changed copy is not that of the file
    return topomap


def open_map_coarse_localizer(topomap: TopoMetricMap, name: str) -> CoarseLocalizer:
    """A map's coarse localizer, which names nodes by their rows. In `surf-vlad` what sets lights
    apart counts for less, where the map's sessions were taken in several. Raises MapError where the
    map has none of this name, or it is damaged."""
    if (of_kind := f"{name}@{topomap.kind}") in topomap.coarse_models:
        name = of_kind
    if name not in topomap.coarse_models:
        available = ", ".join(name for name in topomap.coarse_models if "@" not in name) or "none"
        raise MapError(f"the map has no coarse localizer {name!r} (it has: {available})")
    coarse = open_coarse_localizer(
        node_ids_to_rows(
            topomap.coarse_models[name], [summary.node_id for summary in topomap.summaries]
        )
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


def node_ids_to_rows(model: CoarseModel, ids: Sequence[int]) -> CoarseModel:
    """A stored model, which names nodes by their `ids`, as one that names them by their rows; what
    it knows of others is left out."""
    known = model.arrays.get("node_ids", _output_node_ids(model))
    if known is None or known.ndim != 1 or known.dtype.kind not in "iu":
        return model  # it says itself what is wrong with it
    if list(ids) == list(range(len(ids))) and (
        len(known) == 0 or 0 <= known.min() <= known.max() < len(ids)
    ):
        return model
    rows = {node_id: row for row, node_id in enumerate(ids)}
    of_known = np.array([rows.get(int(node_id), -1) for node_id in known], np.int64)
    if "vectors" not in model.arrays:  # one output a node
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
    """Of a model with an output for each node there was when it was made, in the order of their
    ids."""
    num_nodes = model.settings.get("num_nodes")
    return (
        np.arange(num_nodes) if isinstance(num_nodes, int) and 0 <= num_nodes <= 1_000_000 else None
    )
