"""Read a map from its file. Nodes, images and coarse localizers are read when accessed."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float32

from topoloc.bounds import parse_settings
from topoloc.features.feature_types import find_feature_type
from topoloc.geometry.camera import Camera
from topoloc.geometry.geodesy import Georeference
from topoloc.json_data import Finite, decode_json
from topoloc.mapping.certificate import Certificate
from topoloc.mapping.config import CONFIG_VERSION, config_from_text
from topoloc.mapping.landmark_statistics import LandmarkStatistics, decode_statistics
from topoloc.mapping.storage.entries import (
    CorrelatedErrors,
    Edge,
    Edit,
    Layer,
    LazyMapping,
    NextIds,
    NodeSummary,
    PlaceImage,
    Repetitions,
    Session,
    TopoNode,
    VirtualNodes,
)
from topoloc.mapping.storage.map_file import MapFile
from topoloc.mapping.storage.point_encoding import model_from_row, moves_from_row, points_from_row
from topoloc.mapping.storage.schema import (
    SORT_COLUMNS,
    VIRTUAL_PREFIX,
    layer_suffix,
    split_layer_name,
)
from topoloc.mapping.validation import (
    MAX_POINTS,
    CorruptDataError,
    camera_from_text,
    check_count,
    pose_from_bytes,
)
from topoloc.node_ids import LazySequence, NodeId, Row

T = TypeVar("T")
MAX_ID = 2**53


def open_contents(path: Path, digest: str | None = None) -> tuple[MapFile, dict[str, Any]]:
    """Open a map file and return it with the fields of its `TopoMetricMap`, without reading the
    nodes. It stays open. Raises MapError and MapVersionError as `MapFile`."""
    file = MapFile(path, digest)
    try:
        with file.read_connection():
            return file, _read_fields(file)
    except BaseException:
        file.close()
        raise


def _read_fields(file: MapFile) -> dict[str, Any]:
    facts = file.facts
    for key in ("config", "length_m"):
        if key not in facts:
            raise CorruptDataError(f"key {key!r} of table map is missing")
    config = config_from_text(facts["config"], CONFIG_VERSION if file.version > 1 else None)
    kinds = _decode_fact(facts, "kinds", list[str], [config.features.kind])
    if len(kinds) > 8 or len(set(kinds)) < len(kinds):
        raise CorruptDataError("kinds: at most 8 different names are expected")
    if kinds[:1] != [config.features.kind]:
        raise CorruptDataError(f"kinds: {kinds} do not begin with that of the configuration")
    for kind in kinds:
        find_feature_type(kind)
    map_id = facts.get("map_id")
    if map_id is not None and not re.fullmatch("[0-9a-f]{16}", map_id):
        raise CorruptDataError("map_id: 16 hexadecimal digits are expected")
    moves = _lazy_entries(file, "repetitions", moves_from_row)
    of_earth = facts.get("georeference")
    changes = _decode_fact(facts, "changes", dict[str, dict[str, Any]], {})
    return {
        "summaries": _lazy_rows(file, "nodes", _read_summary, ""),
        "layers": {kind: _read_layer(file, kind, config.features.kind) for kind in kinds},
        "edges": [Edge(row["source_id"], row["target_id"]) for row in file.rows("edges")],
        "place_images": _lazy_rows(file, "place_images", _read_place_image),
        "config": config,
        "length_m": _decode_fact(facts, "length_m", Finite, 0.0),
        "default_coarse": _decode_fact(facts, "default_coarse", str, "surf-vlad"),
        "repetitions": Repetitions(facts["repetitions"], moves) if "repetitions" in facts else None,
        "sides": _read_virtual_nodes(file, kinds),
        "sessions": list(_read_sessions(file).values()),
        "edits": [
            Edit(**row, changes=changes.get(str(row["edit_id"]))) for row in file.rows("edits")
        ],
        "next_ids": _decode_fact(facts, "next_ids", NextIds, NextIds()),
        "map_id": map_id,
        "georeference": None if of_earth is None else Georeference.from_json(of_earth),
        "certificate": _decode_fact(facts, "certificate", Certificate, None),
    }


def list_coarse_models(path: Path) -> list[dict[str, Any]]:
    """Return the name, bytes, backbone and weights of each coarse localizer of a map file. Raises
    MapError."""
    query = "SELECT name, settings, length(arrays) FROM coarse_models ORDER BY name LIMIT 1000"
    with closing(MapFile(path)) as file, file.read_connection() as database:
        return [_model_facts(*row) for row in database.execute(query)]


def _model_facts(name: str, text: str, num_bytes: int) -> dict[str, Any]:
    settings = decode_json(text, dict[str, Any], CorruptDataError, f"coarse localizer {name}")
    return {"name": name, "bytes": num_bytes} | {
        key: settings[key] for key in ("backbone", "weights", "trained") if key in settings
    }


def _decode_fact(facts: Mapping[str, str], key: str, kind: Any, default: T) -> T:
    """Decode an entry of the table `map`. Return `default` if it is missing."""
    return decode_json(facts[key], kind, CorruptDataError, key) if key in facts else default


# No return types: a type check at run time would read an entry.
def _read_virtual_nodes(file: MapFile, kinds: Sequence[str]):
    """Return the virtual nodes, if any, of a map with these feature types."""
    if file.count(f"{VIRTUAL_PREFIX}nodes") == 0:
        return None
    kind = _decode_fact(file.facts, "kind_of_sides", str, kinds[0])
    if kind not in {*kinds, *(find_feature_type(one).virtual_view_type for one in kinds)}:
        raise CorruptDataError(f"kind_of_sides: the map has no features {kind!r}")
    table = f"{VIRTUAL_PREFIX}nodes"
    return VirtualNodes(
        _lazy_rows(file, table, _read_summary, VIRTUAL_PREFIX),
        _lazy_rows(file, table, _read_node, kind, VIRTUAL_PREFIX, True),
        _lazy_entries(file, f"{VIRTUAL_PREFIX}coarse_models", model_from_row),
        kind,
    )


def _read_layer(file: MapFile, kind: str, first: str):
    """Return the layer of a feature type, given the map's first type, whose numbers of points are
    those of the summaries."""
    suffix = layer_suffix(kind, first)
    return Layer(
        _lazy_rows(file, "nodes", _read_node, kind, "", kind == first),
        _lazy_entries(file, "coarse_models", model_from_row, suffix),
        _decode_fact(file.facts, f"shared_errors{suffix}", CorrelatedErrors, None),
    )


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


def _session_from_row(row: dict[str, Any]) -> Session:
    facts = decode_json(row.pop("json"), dict[str, Any], CorruptDataError, "session")
    camera = facts.pop("camera", None)
    session = parse_settings(Session, facts | row, "session")
    return session if camera is None else replace(session, camera=Camera.from_json(camera))


def _lazy_rows(file: MapFile, table: str, read: Callable[..., T], *given: Any) -> LazySequence[T]:
    """Return the entries that `read(file, *given, row)` makes of the rows of a table."""
    return LazySequence(partial(file.count, table), partial(read, file, *given))


def _read_summary(file: MapFile, prefix: str, row: Row) -> NodeSummary:
    return _read_summaries(file, prefix)[row][0]


def _read_summaries(file: MapFile, prefix: str) -> list[tuple[NodeSummary, int]]:
    """Return the summaries of all nodes with the ids of their cameras. They are read together at
    the first access, a few dozen bytes per node."""

    def read() -> list[tuple[NodeSummary, int]]:
        with file.read_connection():
            known = _read_summaries(file, "") if prefix else []
            of_id = {summary.node_id: summary for summary, _ in known}
            rows = file.rows(f"{prefix}nodes")
            return [(_summary_from_row(row, file, of_id), row["camera_id"]) for row in rows]

    return file.cached(f"{prefix}summaries", read)


def _summary_from_row(
    row: Mapping[str, Any], file: MapFile, nodes: Mapping[NodeId, NodeSummary]
) -> NodeSummary:
    """Return the summary of a node. The session of a virtual node is that of its node."""
    node_id = NodeId(check_count(row["node_id"], 0, MAX_ID, "a node's id"))
    what = f"the number of points of node {node_id}"
    num_points = check_count(row["num_points"], 0, MAX_POINTS, what)
    of_node = row.get("of_node")
    if of_node is not None and of_node not in nodes:
        raise CorruptDataError(f"side node {node_id} is of node {of_node}, which is missing")
    session_id = row["session_id"] if of_node is None else nodes[of_node].session_id
    recording, pose = _read_session(file, session_id).name, pose_from_bytes(row["world_from_cam"])
    name, t_ns = row["name"], row["t_ns"]
    return NodeSummary(node_id, recording, name, t_ns, pose, num_points, session_id, of_node)


def _read_node(file: MapFile, kind: str, prefix: str, is_default: bool, row: Row) -> TopoNode:
    """Read the node of a row with its points of a feature type. With the prefix `VIRTUAL_PREFIX` it
    is a virtual node, which has no template. For the first type (`is_default`), the number of
    points is checked against the summary. Raises MapError."""
    with file.read_connection():
        summary, camera_id = _read_summaries(file, prefix)[row]
        node_id, what = summary.node_id, f"{prefix}node {summary.node_id}"
        points = file.row(
            f"{prefix}node_points", f"the points of {what}", node_id=node_id, kind=kind
        )
        features, points_cam, sqrt_covs, stored = points_from_row(points, kind, file.version, what)
        template, statistics = b"", ()
        if not prefix:
            template = _LazyTemplate(file, node_id)
            statistics = _LazyStatistics(file, node_id, kind, sqrt_covs)
        n = len(features)
        if is_default and summary.num_points != n:
            raise CorruptDataError(f"node {node_id} has {n} points")
        summary = summary if summary.num_points == n else replace(summary, num_points=n)
        camera = file.cached(f"camera {camera_id}", lambda: _read_camera(file, camera_id))
        of_node = features, points_cam, sqrt_covs, template, statistics, stored
        return TopoNode(summary, camera, *of_node)


def _read_camera(file: MapFile, camera_id: int) -> Camera:
    return camera_from_text(file.row("cameras", f"camera {camera_id}", camera_id=camera_id)["json"])


@dataclass(frozen=True)
class _LazyTemplate:
    """Read a node's image when it is called. Only poses that are found need it."""

    file: MapFile
    node_id: NodeId

    def __call__(self) -> bytes:
        with self.file.read_connection():
            what = f"the template of node {self.node_id}"
            return self.file.row("node_templates", what, node_id=self.node_id)["jpeg"]


@dataclass(frozen=True, eq=False)
class _LazyStatistics:
    """Show each session's statistics of a node's points. Localization does not need them, so they
    are read when accessed."""

    file: MapFile
    node_id: NodeId
    kind: str
    sqrt_covs: Float32[np.ndarray, "n 6"]

    def __iter__(self) -> Iterator[LandmarkStatistics]:
        n, what = len(self.sqrt_covs), f"the sums of node {self.node_id}"
        with self.file.read_connection():
            found = [
                decode_statistics(
                    row["session_id"],
                    row["sums"],
                    check_count(row["num_rows"], 0, n, what),
                    self.sqrt_covs,
                )
                for row in self.file.find("landmark_sums", node_id=self.node_id, kind=self.kind)
            ]
        return iter(found)


def _read_place_image(file: MapFile, row: int) -> PlaceImage:
    with file.read_connection():
        image_id = file.cached("image_ids", partial(file.rows, "place_images", ("image_id",)))[row]
        found = file.row("place_images", f"place image {image_id['image_id']}", **image_id)
        session = _read_session(file, found["session_id"])
        pose = pose_from_bytes(found["world_from_cam"])
        entry = found["name"], found["node_id"], pose, found["jpeg"]
        return PlaceImage(session.name, *entry, session.session_id, found["image_id"])


def _lazy_entries(
    file: MapFile, table: str, read: Callable[[dict[str, Any]], T], suffix: str | None = None
) -> LazyMapping[Any, T]:
    """Return the entries that `read` makes of the rows of a table by their key, or those of one
    layer by the names in it."""
    key = SORT_COLUMNS[table]
    return LazyMapping(
        partial(_stored_keys, file, table, key, suffix),
        partial(_read_entry, file, table, key, read),
    )


def _stored_keys(file: MapFile, table: str, key: str, suffix: str | None) -> dict[Any, Any]:
    stored = [row[key] for row in file.cached(table, partial(file.rows, table, (key,)))]
    if suffix is None:
        return {one: one for one in stored}
    return {name: one for one in stored for name, of in [split_layer_name(one)] if of == suffix}


def _read_entry(
    file: MapFile, table: str, key: str, read: Callable[[dict[str, Any]], T], stored: int | str
) -> T:
    with file.read_connection():
        return read(file.row(table, f"{table} {stored}", **{key: stored}))
