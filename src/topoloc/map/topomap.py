"""The topo-metric map of the paper (section III-A): nodes with features and their 3-D positions, edges, place images.

Data only: `build.py` makes it, `writing.py` writes and `reading.py` reads it, `localization` asks it.

Everything in a map has an id that never changes and is never used again. Whoever computes works on rows, which the open map derives: row
i is `summaries[i]` and `nodes[i]`, and `row_of` leads there from an id.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, no_type_check

import numpy as np

from topoloc.errors import MapError
from topoloc.map.config import MapConfig
from topoloc.map.entries import Edge, NodeSummary, PlaceImage, Repetitions, SharedErrors, SideNodes, TopoNode
from topoloc.map.file import MapFile
from topoloc.map.sessions import Edit, Session
from topoloc.places.coarse import CoarseLocalizer, CoarseModel, open_coarse

__all__ = [
    "Edge",
    "Edit",
    "NodeSummary",
    "PlaceImage",
    "Repetitions",
    "Session",
    "SharedErrors",
    "SideNodes",
    "TopoMetricMap",
    "TopoNode",
    "open_coarse_of",
]


@dataclass(frozen=True)
class NextIds:
    """The ids that new entries of a map get: more than any that was ever used in it."""

    session: int = 0
    node: int = 0
    place_image: int = 1
    side_node: int = 0
    edit: int = 1


@no_type_check  # at run time: it would read from the file to look at entries' types
@dataclass(frozen=True, eq=False)
class TopoMetricMap:
    """The map. In a map that was loaded, every sequence and mapping reads the file only when an entry is asked for.

    `summaries[i]` describes `nodes[i]`; their ids are in increasing order. `config` is the effective configuration it
    was built with, `length_m` the metres of trajectory that were mapped. `default_coarse` names the coarse localizer that answers
    where the user names none. `shared_errors` and `repetitions` are None where nobody has measured
    them, `sides` where no mapping picture is wide enough to show the walls along the way. `edits` begins with the build.
    `other_kinds` are the same nodes with points of further kinds of features, by the kind's name.

    A map that was loaded holds its file open; ``with TopoMetricMap.load(path) as topomap`` or `close` let go of it. It is pickled as
    its path, and several threads may read it.
    """

    summaries: Sequence[NodeSummary]
    nodes: Sequence[TopoNode]
    edges: Sequence[Edge]
    place_images: Sequence[PlaceImage]
    coarse_models: Mapping[str, CoarseModel]
    config: MapConfig = field(default_factory=MapConfig)
    length_m: float = 0.0
    default_coarse: str = "surf-vlad"
    shared_errors: SharedErrors | None = None
    repetitions: Repetitions | None = None
    sides: SideNodes | None = None
    sessions: Sequence[Session] = ()
    edits: Sequence[Edit] = ()
    next_ids: NextIds = NextIds()
    other_kinds: Mapping[str, Sequence[TopoNode]] = field(default_factory=dict)

    def row_of(self, node_id: int) -> int:
        """The row of a node. Raises KeyError where the map has no node of this id."""
        return self._rows[node_id]

    @property
    def kind(self) -> str:
        """The kind of features that the nodes' points are described with, and queries must be."""
        return self.config.features.kind

    @cached_property
    def _rows(self) -> dict[int, int]:
        return {summary.node_id: row for row, summary in enumerate(self.summaries)}

    def save(self, path: str | Path) -> None:
        """Write the map file at once or not at all. Raises MapError."""
        from topoloc.map.writing import save_map

        save_map(self, Path(path))

    @staticmethod
    def load(path: str | Path) -> TopoMetricMap:
        """Open a map file; nodes are read when asked for. Raises MapError, MapVersionError."""
        from topoloc.map.reading import open_map

        return open_map(Path(path))

    def close(self) -> None:
        """Let go of the file, where the map was loaded; what is asked of it afterwards is a MapError."""
        if self.file is not None:
            self.file.close()

    def __enter__(self) -> TopoMetricMap:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    @property
    def file(self) -> MapFile | None:
        """Where the map comes from as it is; a changed one (`dataclasses.replace`) is no longer that of the file."""
        return self.__dict__.get("_opened")

    def __reduce__(self) -> Any:
        if self.file is None:
            return super().__reduce__()
        return _load_same, (str(self.file.path.absolute()), self.file.digest)


def _load_same(path: str, digest: str) -> TopoMetricMap:
    """The map that was pickled. Raises MapError where another one is in its place by now."""
    from topoloc.map.reading import open_map

    return open_map(Path(path), digest)


def open_coarse_of(topomap: TopoMetricMap, name: str) -> CoarseLocalizer:
    """A map's coarse localizer, which names nodes by their rows. Raises MapError where the map has none of this name, or it is damaged."""
    if name not in topomap.coarse_models:
        available = ", ".join(topomap.coarse_models) or "none"
        raise MapError(f"the map has no coarse localizer {name!r} (it has: {available})")
    return open_coarse(in_rows(topomap.coarse_models[name], [summary.node_id for summary in topomap.summaries]))


def in_rows(model: CoarseModel, ids: Sequence[int]) -> CoarseModel:
    """A stored model, which names nodes by their `ids`, as one that names them by their rows; what it knows of others is left out."""
    known = model.arrays.get("node_ids", _outputs_of(model))
    if known is None or known.ndim != 1 or known.dtype.kind not in "iu":
        return model  # it says itself what is wrong with it
    if list(ids) == list(range(len(ids))) and (len(known) == 0 or 0 <= known.min() <= known.max() < len(ids)):
        return model
    rows = {node_id: row for row, node_id in enumerate(ids)}
    of_known = np.array([rows.get(int(node_id), -1) for node_id in known], np.int64)
    if "vectors" not in model.arrays:  # one output a node
        return replace(model, arrays={**model.arrays, "node_ids": of_known})
    kept = of_known >= 0
    if not kept.any():
        raise MapError(f"the map's coarse localizer {model.name!r} knows none of its nodes")
    per_vector = {name: model.arrays[name][kept] for name in ("vectors", "centres") if len(model.arrays.get(name, ())) == len(kept)}
    return replace(model, arrays={**model.arrays, **per_vector, "node_ids": of_known[kept]})


def in_ids(model: CoarseModel, ids: Sequence[int]) -> CoarseModel:
    """The inverse of `in_rows`: a model that was made of the map's rows, as the map keeps it."""
    if list(ids) == list(range(len(ids))):
        return model
    rows = model.arrays.get("node_ids", np.arange(len(ids)))
    return replace(model, arrays={**model.arrays, "node_ids": np.asarray(ids, np.int64)[rows]})


def _outputs_of(model: CoarseModel) -> np.ndarray | None:
    """Of a model with an output for each node there was when it was made, in the order of their ids."""
    num_nodes = model.settings.get("num_nodes")
    return np.arange(num_nodes) if isinstance(num_nodes, int) and 0 <= num_nodes <= 1_000_000 else None
