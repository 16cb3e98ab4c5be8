"""Define the contents of a map as data. `map_reading.py` reads them, `map_writing.py` writes them,
and `topomap.py` makes a map of them."""

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
    """Hold the ids of the next new entries. They are larger than any id ever used in the map."""

    session: int = 0
    node: int = 0
    place_image: int = 1
    side_node: int = 0
    edit: int = 1


_MAP_ID = b"map id"


@no_type_check  # a type check at run time would read entries from the file
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


@no_type_check  # as for layers
@dataclass(frozen=True, eq=False)
class MapContents:
    """Hold all contents of a map.

    - `summaries[i]` describes the node of row i. Their ids increase.
    - `layers` holds the points of the nodes by feature type.
    - `config` is the resolved configuration of the build.
    - `length_m` is the mapped trajectory length in metres.
    - `default_coarse` names the default coarse localizer.
    - `repetitions` is None if not measured.
    - `sides` holds the virtual nodes. None if no mapping image is wide enough to show the walls
      beside the trajectory.
    - `edits` begins with the build.
    - `map_id` stays the same through all edits. None until the map is saved, and in older files.
    - `georeference` is the pose of the map's world on earth, if known.
    """

    summaries: Sequence[NodeSummary]
    layers: Mapping[str, Layer]
    edges: Sequence[Edge]
    place_images: Sequence[PlaceImage]
    config: MapConfig = field(default_factory=MapConfig)
    length_m: float = 0.0
    default_coarse: str = "surf-vlad"
    repetitions: Repetitions | None = None
    sides: VirtualNodes | None = None
    sessions: Sequence[Session] = ()
    edits: Sequence[Edit] = ()
    next_ids: NextIds = NextIds()
    map_id: str | None = None
    georeference: Georeference | None = None

    @property
    def kind(self) -> str:
        """Return the first feature type of the map, which queries use first."""
        return self.config.features.kind

    @property
    def version(self) -> int:
        """Return the number of the last edit: 1 after the build, 0 without a history."""
        return max((edit.edit_id for edit in self.edits), default=0)

    @property
    def free_ids(self) -> NextIds:
        """Return ids that were never used in the map. Place images receive theirs at writing."""
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

    @property
    def kinds(self) -> list[str]:
        """Return all feature types of the map, the first type first."""
        return [self.kind, *sorted(self.layers.keys() - {self.kind})]

    @property
    def first_layer(self) -> Layer:
        """Return the layer of the first feature type."""
        return self.layers[self.kind]

    @property
    def nodes(self) -> Sequence[TopoNode]:
        """Return the nodes with their points of the first feature type."""
        return self.first_layer.nodes

    def sides_for(self, kind: str) -> VirtualNodes | None:
        """Return the virtual nodes that are queried with this feature type, if any."""
        return self.sides if self.sides is not None and self.sides.is_used_with(kind) else None


def get_map_id(contents: MapContents) -> str:
    """Return the map's id, 16 hexadecimal digits. It is computed from the nodes if the map has none
    yet."""
    return contents.map_id or compute_nodes_digest(contents.summaries, _MAP_ID)
