"""Read a map from its file. Nodes, images and coarse localizers are read when accessed."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from topoloc.bounds import parse_settings
from topoloc.errors import MapError
from topoloc.features.feature_types import find_feature_type
from topoloc.geometry.camera import Camera
from topoloc.geometry.geodesy import Georeference
from topoloc.json_data import decode_json
from topoloc.mapping.config import CONFIG_VERSION, MapConfig, config_from_text
from topoloc.mapping.landmark_statistics import LandmarkStatistics, decode_statistics
from topoloc.mapping.sessions import Edit, Session
from topoloc.mapping.storage.entries import (
    CorrelatedErrors,
    Edge,
    NodeSummary,
    PlaceImage,
    Repetitions,
    TopoNode,
    VirtualNodes,
)
from topoloc.mapping.storage.map_file import MapFile
from topoloc.mapping.storage.point_encoding import points_from_row
from topoloc.mapping.storage.schema import (
    SORT_COLUMNS,
    VIRTUAL_PREFIX,
    layer_suffix,
    split_layer_name,
)
from topoloc.mapping.topomap import Layer, NextIds, TopoMetricMap
from topoloc.mapping.validation import (
    MAX_POINTS,
    CorruptDataError,
    arrays_from_npz,
    camera_from_text,
    check_count,
    pose_from_bytes,
)
from topoloc.node_ids import NodeId, Row, as_rows
from topoloc.retrieval.coarse import CoarseModel

T = TypeVar("T")
K = TypeVar("K", int, str)
V = TypeVar("V")
MAX_ID = 2**53
_MAX_MOVES = 1000


def open_map(path: Path, digest: str | None = None) -> TopoMetricMap:
    """Open a map file without reading its nodes. It stays open.

    Args:
        path: the map file.
        digest: the expected digest. Another one is an error.

    Raises:
        MapError: the file is missing, not a topoloc map, truncated, damaged, or has another digest.
        MapVersionError: the schema is unknown to this version.
    """
    file = MapFile(path)
    try:
        if digest is not None and file.digest != digest:
            raise MapError(f"map {path} is not the one that was pickled: it was replaced since")
        with file.read_connection():
            topomap = _read_contents(file)
            topomap.__dict__["_opened"] = file  # not a field, so that a changed copy has no file
            return topomap
    except BaseException:
        file.close()
        raise


def _read_contents(file: MapFile) -> TopoMetricMap:
    facts = file.facts
    missing = [key for key in ("config", "length_m") if key not in facts]
    if missing:
        raise CorruptDataError(f"key {missing[0]!r} of table map is missing")
    config = config_from_text(facts["config"], CONFIG_VERSION if file.version > 1 else None)
    kinds = _read_feature_types(facts, config)
    sides = None
    if file.count(f"{VIRTUAL_PREFIX}nodes") > 0:
        kind = (
            decode_json(facts["kind_of_sides"], str, CorruptDataError, "kind_of_sides")
            if "kind_of_sides" in facts
            else config.features.kind
        )
        if kind not in {*kinds, *(find_feature_type(one).virtual_view_type for one in kinds)}:
            raise CorruptDataError(f"kind_of_sides: the map has no features {kind!r}")
        models = _LazyMapping(file, f"{VIRTUAL_PREFIX}coarse_models", _model_from_row)
        sides = VirtualNodes(
            _lazy_summaries(file, VIRTUAL_PREFIX),
            _lazy_nodes(file, kind, VIRTUAL_PREFIX),
            models,
            kind,
        )
    return TopoMetricMap(
        summaries=_lazy_summaries(file),
        layers={kind: _read_layer(file, kind, config.features.kind) for kind in kinds},
        edges=[Edge(row["source_id"], row["target_id"]) for row in file.rows("edges")],
        place_images=_LazySequence(
            partial(file.count, "place_images"), partial(_read_place_image, file)
        ),
        config=config,
        length_m=_read_length(facts["length_m"]),
        default_coarse=decode_json(
            facts.get("default_coarse", '"surf-vlad"'), str, CorruptDataError, "default_coarse"
        ),
        repetitions=(
            Repetitions(facts["repetitions"], _LazyMapping(file, "repetitions", _moves_from_row))
            if "repetitions" in facts
            else None
        ),
        sides=sides,
        sessions=list(_read_sessions(file).values()),
        edits=_read_edits(file),
        next_ids=parse_settings(
            NextIds, _decode_object(facts.get("next_ids", "{}"), "next_ids"), "next_ids"
        ),
        map_id=_read_map_id(facts),
        georeference=(
            Georeference.from_json(facts["georeference"]) if "georeference" in facts else None
        ),
    )


def _decode_object(text: str, what: str) -> dict[str, Any]:
    return decode_json(text, dict[str, Any], CorruptDataError, what)


def _read_length(text: str) -> float:
    length = decode_json(text, float, CorruptDataError, "length_m")
    if not math.isfinite(length):
        raise CorruptDataError("length_m: a finite number is expected")
    return length


def _read_feature_types(facts: Mapping[str, str], config: MapConfig) -> list[str]:
    """Return the feature types of the map, the first type first."""
    kinds = (
        decode_json(facts["kinds"], list[str], CorruptDataError, "kinds")
        if "kinds" in facts
        else [config.features.kind]
    )
    if len(kinds) > 8 or len(set(kinds)) < len(kinds):
        raise CorruptDataError("kinds: at most 8 different names are expected")
    if kinds[:1] != [config.features.kind]:
        raise CorruptDataError(f"kinds: {kinds} do not begin with that of the configuration")
    for kind in kinds:
        find_feature_type(kind)
    return kinds


# No return type, see below.
def _read_layer(file: MapFile, kind: str, first: str):
    """Return the layer of a feature type, given the map's first type."""
    suffix = layer_suffix(kind, first)
    return Layer(
        _lazy_nodes(file, kind, is_default=kind == first),
        _LazyMapping(file, "coarse_models", _model_from_row, suffix),
        _read_correlated_errors(file.facts, f"shared_errors{suffix}"),
    )


def _read_map_id(facts: Mapping[str, str]) -> str | None:
    map_id = facts.get("map_id")
    if map_id is not None and not re.fullmatch("[0-9a-f]{16}", map_id):
        raise CorruptDataError("map_id: 16 hexadecimal digits are expected")
    return map_id


def _read_correlated_errors(facts: Mapping[str, str], key: str) -> CorrelatedErrors | None:
    if key not in facts:
        return None
    found = parse_settings(CorrelatedErrors, _decode_object(facts[key], key), key)
    if not 0.0 <= found.rho < math.inf:
        raise CorruptDataError("shared errors that are no share")
    return found


def _read_edits(file: MapFile) -> list[Edit]:
    changes = decode_json(
        file.facts.get("changes", "{}"), dict[str, dict[str, Any]], CorruptDataError, "changes"
    )
    return [Edit(**row, changes=changes.get(str(row["edit_id"]))) for row in file.rows("edits")]


def _read_sessions(file: MapFile) -> dict[int, Session]:
    return file.cached(
        "sessions",
        lambda: {row["session_id"]: _session_from_row(row) for row in file.rows("sessions")},
    )


def _read_session(file: MapFile, session_id: int) -> Session:
    sessions = _read_sessions(file)
    if session_id not in sessions:
        raise CorruptDataError(f"session {session_id} is missing")
    return sessions[session_id]


def _session_from_row(row: Mapping[str, Any]) -> Session:
    facts = _decode_object(row["json"], "session")
    camera = facts.pop("camera", None)
    session = parse_settings(
        Session, facts | {"session_id": row["session_id"], "name": row["name"]}, "session"
    )
    return session if camera is None else replace(session, camera=Camera.from_json(camera))


class _LazySequence(Sequence[T]):
    """Show rows of the map, numbered from 0, and read each when accessed."""

    def __init__(self, length: Callable[[], int], read: Callable[[Row], T]) -> None:
        self._length, self._read = length, read

    def __len__(self) -> int:
        return self._length()

    def __getitem__(self, index):  # type: ignore[override]
        if isinstance(index, slice):
            return [self._read(row) for row in as_rows(range(*index.indices(len(self))))]
        position = index + len(self) if index < 0 else index
        if not 0 <= position < len(self):
            raise IndexError(index)
        return self._read(Row(int(position)))


# No return types: a type check at run time would read an entry.
def _lazy_summaries(file: MapFile, prefix: str = ""):
    """Return the summaries of all nodes. They are read together at the first access, a few dozen
    bytes per node."""
    return _LazySequence(
        partial(file.count, f"{prefix}nodes"), partial(_read_summary, file, prefix)
    )


def _lazy_nodes(file: MapFile, kind: str, prefix: str = "", is_default: bool = True):
    """Return nodes with their points of one feature type. For the first type (`is_default`), the
    number of points is checked against the summary."""
    return _LazySequence(
        partial(file.count, f"{prefix}nodes"), partial(_read_node, file, kind, prefix, is_default)
    )


def _read_summary(file: MapFile, prefix: str, row: Row) -> NodeSummary:
    return _read_summaries(file, prefix)[row]


def _read_summaries(file: MapFile, prefix: str) -> list[NodeSummary]:
    def read() -> list[NodeSummary]:
        with file.read_connection():
            rows = file.rows(f"{prefix}nodes")
            of_id = (
                {summary.node_id: summary for summary in _read_summaries(file, "")}
                if prefix
                else {}
            )
            return [_summary_from_row(row, file, of_id if prefix else None) for row in rows]

    return file.cached(f"{prefix}summaries", read)


def _summary_from_row(
    row: Mapping[str, Any], file: MapFile, nodes: Mapping[NodeId, NodeSummary] | None
) -> NodeSummary:
    """Return the summary of a node. With `nodes` it is a virtual node, whose session is that of its
    node."""
    node_id = NodeId(check_count(row["node_id"], 0, MAX_ID, "a node's id"))
    num_points = check_count(
        row["num_points"], 0, MAX_POINTS, f"the number of points of node {node_id}"
    )
    if nodes is not None and row["of_node"] not in nodes:
        raise CorruptDataError(f"side node {node_id} is of node {row['of_node']}, which is missing")
    session_id = row["session_id"] if nodes is None else nodes[row["of_node"]].session_id
    recording, pose = _read_session(file, session_id).name, pose_from_bytes(row["world_from_cam"])
    return NodeSummary(
        node_id,
        recording,
        row["name"],
        row["t_ns"],
        pose,
        num_points,
        session_id,
        row.get("of_node"),
    )


def _read_node(file: MapFile, kind: str, prefix: str, is_default: bool, row: Row) -> TopoNode:
    """Read the node of a row with its points of a feature type. With the prefix `VIRTUAL_PREFIX` it
    is a virtual node, which has no template. Raises MapError."""
    with file.read_connection():
        summary = _read_summaries(file, prefix)[row]
        node_id, what = summary.node_id, f"{prefix}node {summary.node_id}"
        points = _require_row(
            file.row(f"{prefix}node_points", node_id=node_id, kind=kind), f"the points of {what}"
        )
        template = (
            b""
            if prefix
            else _require_row(
                file.row("node_templates", node_id=node_id), f"the template of {what}"
            )["jpeg"]
        )
        features, points_cam, sqrt_covs, stored = points_from_row(points, kind, file.version, what)
        n = len(features)
        if is_default and summary.num_points != n:
            raise CorruptDataError(f"node {node_id} has {n} points")
        summary = summary if summary.num_points == n else replace(summary, num_points=n)
        session_statistics = () if prefix else _LazyStatistics(file, node_id, kind, n)
        return TopoNode(
            summary,
            _read_camera(file, prefix, node_id),
            features,
            points_cam,
            sqrt_covs,
            template,
            session_statistics,
            stored,
        )


def _read_camera(file: MapFile, prefix: str, node_id: NodeId) -> Camera:
    rows = partial(file.rows, f"{prefix}nodes", ("node_id", "camera_id"))
    camera_id = file.cached(
        f"{prefix}camera_ids", lambda: {row["node_id"]: row["camera_id"] for row in rows()}
    )[node_id]

    def read() -> Camera:
        return camera_from_text(
            _require_row(file.row("cameras", camera_id=camera_id), f"camera {camera_id}")["json"]
        )

    return file.cached(f"camera {camera_id}", read)


class _LazyStatistics:
    """Show each session's statistics of a node's points. Localization does not need them, so they
    are read when accessed."""

    def __init__(self, file: MapFile, node_id: NodeId, kind: str, num_points: int) -> None:
        self._file, self._node_id, self._kind, self._num_points = file, node_id, kind, num_points

    def _list_session_ids(self) -> list[int]:
        with self._file.read_connection() as database:
            query = (
                "SELECT session_id FROM landmark_sums WHERE node_id = ? AND kind = ? ORDER BY"
                " session_id LIMIT 100000"
            )
            return [
                decode_json(row[0], int, CorruptDataError, "landmark_sums.session_id")
                for row in database.execute(query, (self._node_id, self._kind))
            ]

    def __iter__(self) -> Iterator[LandmarkStatistics]:
        with self._file.read_connection():
            found = [self._read_statistics(session_id) for session_id in self._list_session_ids()]
        return iter(found)

    def _read_statistics(self, session_id: int) -> LandmarkStatistics:
        what = f"the sums of node {self._node_id}"
        row = _require_row(
            self._file.row(
                "landmark_sums", node_id=self._node_id, kind=self._kind, session_id=session_id
            ),
            what,
        )
        return decode_statistics(
            session_id,
            row["sums"],
            check_count(row["num_rows"], 0, self._num_points, what),
            self._num_points,
        )


def _read_place_image(file: MapFile, row: int) -> PlaceImage:
    with file.read_connection():
        image_id = file.cached(
            "image_ids",
            lambda: [row["image_id"] for row in file.rows("place_images", ("image_id",))],
        )[row]
        found = _require_row(file.row("place_images", image_id=image_id), f"place image {image_id}")
        session = _read_session(file, found["session_id"])
        pose = pose_from_bytes(found["world_from_cam"])
        return PlaceImage(
            session.name,
            found["name"],
            found["node_id"],
            pose,
            found["jpeg"],
            session.session_id,
            image_id,
        )


class _LazyMapping(Mapping[K, V]):
    """Show rows of a table by their key, or those of one layer by the names in it. Each is read
    when accessed."""

    def __init__(
        self,
        file: MapFile,
        table: str,
        read: Callable[[dict[str, Any]], V],
        suffix: str | None = None,
    ) -> None:
        self._file, self._table, self._read, self._suffix = file, table, read, suffix
        self._key = SORT_COLUMNS[table]

    def _keys(self) -> dict[Any, Any]:
        """Return the stored key of each key."""
        stored = self._file.cached(
            self._table,
            lambda: [row[self._key] for row in self._file.rows(self._table, (self._key,))],
        )
        if self._suffix is None:
            return {key: key for key in stored}
        named = ((*split_layer_name(key), key) for key in stored)
        return {name: key for name, suffix, key in named if suffix == self._suffix}

    def __len__(self) -> int:
        return len(self._keys())

    def __iter__(self) -> Iterator[K]:
        return iter(self._keys())

    def __getitem__(self, key: K) -> V:
        stored = self._keys()[key]
        with self._file.read_connection():
            row = self._file.row(self._table, **{self._key: stored})
            return self._read(_require_row(row, f"{self._table} {stored}"))


def _model_from_row(row: dict[str, Any]) -> CoarseModel:
    name, what = row["name"], f"coarse localizer {row['name']}"
    settings = _decode_object(row["settings"], what)
    arrays = arrays_from_npz(row["arrays"], what)
    return CoarseModel(split_layer_name(name)[0], settings, arrays)


def _moves_from_row(row: dict[str, Any]) -> np.ndarray:
    num_moves = check_count(
        row["num_moves"], 1, _MAX_MOVES, f"the repetitions of node {row['node_id']}"
    )
    size = len(row["moves"]) // num_moves
    return np.array(
        [
            pose_from_bytes(row["moves"][k * size : (k + 1) * size]).matrix()
            for k in range(num_moves)
        ]
    )


def _require_row(row: dict[str, Any] | None, what: str) -> dict[str, Any]:
    if row is None:
        raise CorruptDataError(f"{what} is missing")
    return row
