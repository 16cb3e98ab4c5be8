"""Define the topo-metric map (section III-A of the paper): nodes with features and 3-D positions,
edges, place images.

`build.py` creates it, `map_writing.py` writes it, `map_reading.py` reads it, `edit.py` edits it,
and `localization` uses it.

Every entry has an id that never changes and is never reused. Computations use rows: row i is
`summaries[i]` and `nodes[i]`. `row_of` converts an id to a row.
"""

from __future__ import annotations

import html
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, SupportsInt, no_type_check

import numpy as np

from topoloc.errors import EmptyMapError, FeatureTypeError, MapError
from topoloc.features.feature_types import find_feature_type
from topoloc.geometry.geodesy import Georeference
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.certificate import Certificate
from topoloc.mapping.config import MapConfig
from topoloc.mapping.nodes import NodePoses, compute_nodes_digest, node_distances
from topoloc.mapping.storage.entries import (
    Edge,
    Edit,
    Layer,
    NextIds,
    NodeSummary,
    PlaceImage,
    Repetitions,
    Session,
    TopoNode,
    VirtualNodes,
)
from topoloc.mapping.storage.schema import SCHEMA_VERSION
from topoloc.node_ids import NodeId, Row, as_rows

if TYPE_CHECKING:
    from topoloc.mapping.storage.map_file import MapFile


_MAP_ID = b"map id"


@no_type_check  # as for layers
@dataclass(frozen=True, eq=False)
class TopoMetricMap:
    """A topo-metric map.

    - `summaries[i]` describes the node of row i. Their ids increase.
    - `layers` holds the points of the nodes by feature type.
    - `config` is the resolved configuration of the build.
    - `length_m` is the mapped trajectory length in metres (or units, without scale).
    - `default_coarse` names the default coarse localizer.
    - `repetitions` is None if not measured.
    - `sides` holds the virtual nodes. None if no mapping image is wide enough to show the walls
      beside the trajectory.
    - `edits` begins with the build.
    - `map_id` stays the same through all edits. None until the map is saved, and in older files.
    - `georeference` is the pose of the map's world on earth, if known.
    - `certificate` is what `topoloc certify` measured, if it did.

    The sequences and mappings of a loaded map read the file when an entry is accessed. A loaded map
    keeps its file open until `close` or the end of ``with TopoMetricMap.load(path) as topomap``. It
    is pickled as its path. Several threads may read it.
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
    next_ids: NextIds = field(default_factory=NextIds)
    map_id: str | None = None
    georeference: Georeference | None = None
    certificate: Certificate | None = None

    schema_version: ClassVar[int] = SCHEMA_VERSION
    """Schema of the map files that `save` writes."""

    def __repr__(self) -> str:
        nodes = f"{len(self.summaries)} nodes along {self.length_m:.1f} m"
        return f"TopoMetricMap({nodes}, features {', '.join(self.layers)}, version {self.version})"

    def _repr_html_(self) -> str:
        """Return the line of `repr` and a plan, for notebooks."""
        plan = self.node_poses.plan_svg() if self.summaries else ""
        return f"<p>{html.escape(repr(self))}</p>{plan}"

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
        known = self.next_ids
        return replace(
            known,
            session=max([known.session, *(session.session_id + 1 for session in self.sessions)]),
            node=max([known.node, *(summary.node_id + 1 for summary in self.summaries)]),
            edit=max([known.edit, *(edit.edit_id + 1 for edit in self.edits)]),
        )

    @property
    def id(self) -> str:
        """Return the map's id, 16 hexadecimal digits. It is computed from the nodes if the map has
        none yet."""
        return self.map_id or compute_nodes_digest(self.summaries, _MAP_ID)

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
        kinds = (kind, find_feature_type(kind).virtual_view_type)
        return self.sides if self.sides is not None and self.sides.kind in kinds else None

    def describe(self, path: str | Path) -> dict[str, Any]:
        """Return the facts of a map that is stored at `path` as JSON: counts, bytes, metres
        (or lengths in units of a map without scale), junctions, sessions, edits, configuration.
        Raises EmptyMapError: the map has no node."""
        from topoloc.mapping.storage.map_reading import list_coarse_models

        path = Path(path)
        if len(self.summaries) == 0:
            raise EmptyMapError(f"map {path} has no nodes")
        models = list_coarse_models(path)
        centres = np.array([s.world_from_cam.translation for s in self.summaries])
        num_nodes = Counter(summary.session_id for summary in self.summaries)
        unit = "_m" if self.config.has_scale else ""
        return {
            "path": str(path),
            "map": self.id,
            "version": self.version,
            "georeference": None if self.georeference is None else self.georeference.to_json(),
            "certificate": self.describe_certificate(),
            "bytes": path.stat().st_size,
            "num_nodes": len(self.summaries),
            "num_points": sum(s.num_points for s in self.summaries),
            "num_side_nodes": len(self.sides.summaries) if self.sides else 0,
            "num_place_images": len(self.place_images),
            **({} if unit else {"scale": "none"}),
            f"length{unit}": round(self.length_m, 3),
            "junctions": self.junctions,
            f"extent{unit}": np.ptp(centres, axis=0).round(3).tolist(),
            "recordings": sorted({s.recording for s in self.summaries}),
            "sessions": [
                asdict(session)
                | {
                    "camera": None if session.camera is None else session.camera.to_json(),
                    "start_date": session.start_date,
                    "end_date": session.end_date,
                    "num_nodes": num_nodes[session.session_id],
                }
                for session in self.sessions
            ],
            "edits": [asdict(edit) for edit in self.edits],
            "coarse": [model["name"] for model in models],
            "default_coarse": self.default_coarse,
            "kinds": self.kinds,
            "coarse_models": models,
            "config": self.config.to_json(),
        }

    @cached_property
    def junctions(self) -> list[dict[str, Any]]:
        """Return the junctions of the map as JSON (`describe_junctions`)."""
        from topoloc.mapping.junctions import describe_junctions

        return describe_junctions(self)

    def require_scale(self, use: str) -> None:
        """Raise MapError if lengths of the map are not metres, which `use` needs."""
        if not self.config.has_scale:
            name = self.id if self.file is None else self.file.path
            raise MapError(
                f"map {name} has no scale, but {use} needs metres: set it by `topoloc scale {name}"
                " --distance IMAGE_A,IMAGE_B=3.2m`, or --tag METRES"
            )

    def describe_certificate(self) -> dict[str, Any] | None:
        """Return the certificate as JSON, with its promise and whether the map was edited since."""
        one = self.certificate
        if one is None:
            return None
        return one.to_json() | {
            "promise": one.promise(),
            "threshold": one.describe_threshold(),
            "is_outdated": one.is_outdated(self.version),
        }

    def row_of(self, node_id: NodeId) -> Row:
        """Return the row of a node. Raises KeyError if the map has no node with this id."""
        return self._rows[node_id]

    def rows_of(self, node_ids: Iterable[SupportsInt]) -> list[Row]:
        """Return the rows of nodes, such as an array of ids. Raises KeyError as `row_of` does."""
        return [self._rows[NodeId(int(node_id))] for node_id in node_ids]

    @property
    def rows(self) -> list[Row]:
        """Return the rows of all nodes."""
        return as_rows(range(len(self.summaries)))

    @cached_property
    def node_poses(self) -> NodePoses:
        """Return the poses of all nodes as arrays."""
        return NodePoses.from_poses([summary.world_from_cam for summary in self.summaries])

    def max_focal_length_px(self) -> float:
        """Return the focal length (pixels) of the finest mapping camera.

        Each session is assumed to have one camera.
        """
        rows = range(len(self.summaries))
        first_rows = {self.summaries[row].session_id: row for row in reversed(rows)}
        return max(float(self.nodes[row].camera.fx) for row in first_rows.values())

    def find_neighbours(self, poses: list[Rigid3], max_neighbours: int) -> list[list[int]]:
        """Return for each of these poses the nearest others of them, by the distance of Eq. 1.

        Entries are positions in `poses`, the nearest first.
        """
        stacked, neighbours = NodePoses.from_poses(poses), list[list[int]]()
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

    def save(self, path: str | Path, on_wait: Callable[[], None] | None = None) -> None:
        """Write the map file atomically. A file that is replaced is kept, and `undo_edit` brings it
        back. Waits while another process edits the map at `path`, and calls `on_wait` once before.
        Raises MapError."""
        from topoloc.mapping.storage.map_writing import save_map

        save_map(self, Path(path), on_wait)

    @staticmethod
    def load(path: str | Path, digest: str | None = None) -> TopoMetricMap:
        """Open a map file. Nodes are read when accessed. Raises MapVersionError, and MapError
        also if the map has another digest than the given one."""
        from topoloc.mapping.storage.map_reading import open_contents

        file, fields = open_contents(Path(path), digest)
        topomap = TopoMetricMap(**fields)
        topomap.__dict__["_opened"] = file  # not a field, so that a changed copy has no file
        return topomap

    def close(self) -> None:
        """Close the file if the map was loaded. Later reads raise MapError."""
        if self.file is not None:
            self.file.close()

    def __enter__(self) -> TopoMetricMap:
        return self

    def __exit__(self, *failure: object) -> None:
        self.close()

    @property
    def file(self) -> MapFile | None:
        """Return the file of a loaded, unchanged map. It is None for a copy changed by
        `dataclasses.replace`."""
        return self.__dict__.get("_opened")

    def __reduce__(self) -> Any:
        if self.file is None:
            return super().__reduce__()
        return TopoMetricMap.load, (self.file.path.absolute(), self.file.digest)
