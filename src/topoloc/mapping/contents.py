"""What a map holds, as `map_reading.py` finds it in a file and `map_writing.py` writes it. Data
only; `topomap.py` makes a map of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import no_type_check

from topoloc.geometry.geodesy import Georeference
from topoloc.mapping.config import MapConfig
from topoloc.mapping.entries import (
    CorrelatedErrors,
    Edge,
    NodeSummary,
    PlaceImage,
    Repetitions,
    TopoNode,
    VirtualNodes,
)
from topoloc.mapping.nodes import compute_nodes_digest
from topoloc.mapping.sessions import Edit, Session
from topoloc.retrieval.coarse import CoarseModel


@dataclass(frozen=True)
class NextIds:
    """The ids that new entries of a map get: more than any that was ever used in it."""

    session: int = 0
    node: int = 0
    place_image: int = 1
    side_node: int = 0
    edit: int = 1


_MAP_ID = b"map id"


@no_type_check  # at run time: it would read from the file to look at entries' types
@dataclass(frozen=True, eq=False)
class MapContents:
    """All of a map. `summaries[i]` describes `nodes[i]`; their ids are in increasing order.
    `config` is the effective configuration it was built with, `length_m` the metres of trajectory
    that were mapped. `default_coarse` names the coarse localizer that answers where the user names
    none. `shared_errors` and `repetitions` are None where nobody has measured them, `sides` where
    no mapping picture is wide enough to show the walls along the way. `edits` begins with the
    build. `map_id` stays what it is whatever becomes of the map; None until it is saved, and in
    older files. `georeference` says where on earth the map's world lies, where that is known.
    `other_kinds` are the same nodes with points of further kinds of features, by the kind's name,
    and `other_shared_errors` what `shared_errors` are of these.
    """

    summaries: Sequence[NodeSummary]
    nodes: Sequence[TopoNode]
    edges: Sequence[Edge]
    place_images: Sequence[PlaceImage]
    coarse_models: Mapping[str, CoarseModel]
    config: MapConfig = field(default_factory=MapConfig)
    length_m: float = 0.0
    default_coarse: str = "surf-vlad"
    shared_errors: CorrelatedErrors | None = None
    repetitions: Repetitions | None = None
    sides: VirtualNodes | None = None
    sessions: Sequence[Session] = ()
    edits: Sequence[Edit] = ()
    next_ids: NextIds = NextIds()
    other_kinds: Mapping[str, Sequence[TopoNode]] = field(default_factory=dict)
    other_shared_errors: Mapping[str, CorrelatedErrors] = field(default_factory=dict)
    map_id: str | None = None
    georeference: Georeference | None = None

    @property
    def kind(self) -> str:
        """The kind of features that the nodes' points are described with, and queries must be."""
        return self.config.features.kind

    @property
    def version(self) -> int:
        """The number of its last edit: 1 as it was built, 0 where it has no history."""
        return max((edit.edit_id for edit in self.edits), default=0)

    @property
    def free_ids(self) -> NextIds:
        """Ids that nothing in the map has or had; place images get theirs when they are written."""
        return replace(
            self.next_ids,
            session=max(
                [self.next_ids.session, *(session.session_id + 1 for session in self.sessions)]
            ),
            node=max([self.next_ids.node, *(summary.node_id + 1 for summary in self.summaries)]),
            edit=max([self.next_ids.edit, *(edit.edit_id + 1 for edit in self.edits)]),
        )

    @property
    def id(self) -> str:
        """The map's id, 16 hexadecimal digits, see `get_map_id`."""
        return get_map_id(self)

    def nodes_of(
        self, kind: str
    ):  # no return type: at run time an entry would be read to look at it
        """The nodes with their points of one of the map's kinds of features. Raises KeyError where
        it holds no such features."""
        return self.nodes if kind == self.kind else self.other_kinds[kind]

    @property
    def kinds(self) -> list[str]:
        """All kinds of features that the map holds, that of the nodes first."""
        return [self.kind, *sorted(self.other_kinds)]


def get_map_id(contents: MapContents) -> str:
    """The map's id, 16 hexadecimal digits; of one that was not saved yet, or by an older version,
    what its nodes make of it."""
    return contents.map_id or compute_nodes_digest(contents.summaries, _MAP_ID)
