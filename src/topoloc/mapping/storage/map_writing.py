"""Write a map file atomically: one SQLite database (see docs/map-format.md), which `map_reading.py`
reads.

A node takes about 100 bytes per point and a small JPEG. `point_encoding.py` and
`landmark_statistics.py` define the encoding of points and session statistics.
"""

from __future__ import annotations

import io
import json
import os
import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, replace
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np

from topoloc.errors import MapError
from topoloc.features.parallel import parallel_map
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.config import config_to_text
from topoloc.mapping.landmark_statistics import encode_statistics
from topoloc.mapping.sessions import Session, sessions_from_names
from topoloc.mapping.storage.entries import TopoNode
from topoloc.mapping.storage.point_encoding import compress_array, node_to_arrays
from topoloc.mapping.storage.schema import (
    APPLICATION_ID,
    SCHEMA_VERSION,
    SORT_COLUMNS,
    TABLES,
    VIRTUAL_PREFIX,
    compute_checksum,
    create_table_statement,
    layer_suffix,
)
from topoloc.mapping.topomap import NextIds, TopoMetricMap
from topoloc.recordings.atomic import atomic_write
from topoloc.retrieval.coarse import CoarseModel

_PAGE_BYTES = 1024
"""A row leaves half of its last page empty on average, and a node has about eight rows. Larger
pages cost 1 to 5 kB more per node."""


def save_map(topomap: TopoMetricMap, path: Path) -> None:
    """Write the map to `path` atomically. A reader sees the old map or the new one.

    Raises:
        MapError: the folder does not exist or cannot be written, or the disk is full. Nothing is
            left behind.
    """
    if os.path.isdir(path):  # Path.is_dir raises an error for names that are too long
        raise MapError(f"cannot write map {path}: it is a folder")
    try:
        with atomic_write(path) as temporary:
            write_map(topomap, temporary)
    except (OSError, ValueError) as error:
        if isinstance(error, ValueError) and "null" not in str(
            error
        ):  # a null character in the name; any other ValueError is a bug
            raise
        raise MapError(f"cannot write map {path}: {error}") from error


def write_map(topomap: TopoMetricMap, path: Path) -> None:
    """Write the map to the empty file `path`. Raises MapError if the disk is full."""
    try:
        # an empty name creates a private temporary database, removed at closing
        with closing(sqlite3.connect("", isolation_level=None)) as database:
            _Writer(database).write(topomap)
            copy_sorted_tables(database, path)
    except sqlite3.OperationalError as error:
        raise MapError(f"cannot write map {path}: {error}") from error


_PointBlobs = tuple[list[bytes], list[bytes]]
"""Encoded points of a node, and encoded statistics of each session."""


class _Writer:
    """Insert rows with checksums and count them. The table `map` is written last, with the counts
    and the digest."""

    def __init__(self, database: sqlite3.Connection) -> None:
        self._database = database
        self._checksums: dict[str, list[tuple[tuple[Any, ...], bytes]]] = {
            table: [] for table in TABLES
        }
        self._camera_ids: dict[str, int] = {}

    def write(self, topomap: TopoMetricMap) -> None:
        """Write all tables of the map in one transaction."""
        self._database.execute("PRAGMA journal_mode = OFF")
        self._database.execute("BEGIN")
        for table in TABLES:
            self._database.execute(create_table_statement(table))
        sessions = topomap.sessions or sessions_from_names(
            [entry.recording for entry in (*topomap.summaries, *topomap.place_images)]
        )
        ids = (
            {session.name: session.session_id for session in sessions}
            if not topomap.sessions
            else {}
        )
        for session in sessions:
            self._insert("sessions", session.session_id, session.name, _session_to_json(session))
        for edit in topomap.edits:
            self._insert("edits", edit.edit_id, edit.name, edit.date, edit.schema)
        self._write_nodes(topomap, ids)
        for edge in sorted(topomap.edges, key=lambda edge: (edge.source_id, edge.target_id)):
            self._insert("edges", edge.source_id, edge.target_id)
        next_image = self._write_images(topomap, ids)
        for kind, layer in topomap.layers.items():
            for model in layer.coarse_models.values():
                suffix = layer_suffix(kind, topomap.kind)
                self._insert_model(replace(model, name=model.name + suffix))
        if topomap.sides is not None:
            virtual_view_type = topomap.sides.kind
            for (of_side,) in parallel_map(
                _encode_nodes, ([(node, virtual_view_type)] for node in topomap.sides.nodes)
            ):
                self._insert_node(*of_side, {}, VIRTUAL_PREFIX)
            for model in topomap.sides.coarse_models.values():
                self._insert_model(model, VIRTUAL_PREFIX)
        if topomap.repetitions is not None:
            for node_id, moves in sorted(topomap.repetitions.moves.items()):
                self._insert(
                    "repetitions", node_id, len(moves), moves[:, :3].astype("<f8").tobytes()
                )
        self._write_metadata(topomap, sessions, next_image)
        self._database.execute("COMMIT")

    def _write_nodes(self, topomap: TopoMetricMap, session_ids: Mapping[str, int]) -> None:
        read = (
            [(topomap.layers[kind].nodes[row], kind) for kind in topomap.kinds]
            for row in range(len(topomap.nodes))
        )
        for (node, kind, blobs), *of_others in parallel_map(_encode_nodes, read):
            self._insert_node(node, kind, blobs, session_ids)
            self._insert("node_templates", node.summary.node_id, node.template_jpeg)
            for of_other in of_others:
                self._insert_points(*of_other)

    def _write_images(self, topomap: TopoMetricMap, session_ids: Mapping[str, int]) -> int:
        """Write the images. Images without an id receive the next ones. Return the id after the
        last."""
        next_id = max(topomap.next_ids.place_image, 1)
        for image in topomap.place_images:
            image_id = next_id if image.image_id is None else image.image_id
            session_id = session_ids.get(image.recording, image.session_id)
            self._insert(
                "place_images",
                image_id,
                session_id,
                image.name,
                image.node_id,
                _pose_to_bytes(image.world_from_cam),
                image.jpeg,
            )
            next_id = max(next_id, image_id + 1)
        return next_id

    def _write_metadata(
        self, topomap: TopoMetricMap, sessions: Sequence[Session], next_image: int
    ) -> None:
        used = NextIds(
            session=max((session.session_id + 1 for session in sessions), default=0),
            node=max((summary.node_id + 1 for summary in topomap.summaries), default=0),
            place_image=next_image,
            side_node=max((summary.node_id + 1 for summary in topomap.sides.summaries), default=0)
            if topomap.sides
            else 0,
            edit=max((edit.edit_id + 1 for edit in topomap.edits), default=1),
        )
        facts = {
            "config": config_to_text(topomap.config),
            "kinds": json.dumps(topomap.kinds),
            "length_m": json.dumps(topomap.length_m),
            "default_coarse": json.dumps(topomap.default_coarse),
            "next_ids": json.dumps(
                {
                    name: max(value, getattr(used, name))
                    for name, value in asdict(topomap.next_ids).items()
                }
            ),
            "counts": json.dumps(
                {table: len(rows) for table, rows in self._checksums.items() if table != "map"}
            ),
        }
        facts["map_id"] = topomap.id
        if changes := {
            str(edit.edit_id): dict(edit.changes) for edit in topomap.edits if edit.changes
        }:
            facts["changes"] = json.dumps(changes)
        if topomap.sides is not None:
            facts["kind_of_sides"] = json.dumps(topomap.sides.kind)
        if topomap.georeference is not None:
            facts["georeference"] = json.dumps(topomap.georeference.to_json())
        for kind, layer in topomap.layers.items():
            if layer.shared_errors is not None:
                key = f"shared_errors{layer_suffix(kind, topomap.kind)}"
                facts[key] = json.dumps(asdict(layer.shared_errors))
        if topomap.repetitions is not None:
            facts["repetitions"] = topomap.repetitions.digest
        for key, value in sorted(facts.items()):
            self._insert("map", key, value)
        self._insert(
            "map",
            "digest",
            compute_map_digest(
                {table: [c for _, c in sorted(rows)] for table, rows in self._checksums.items()}
            ),
        )

    def _insert_node(
        self,
        node: TopoNode,
        kind: str,
        blobs: _PointBlobs,
        session_ids: Mapping[str, int],
        prefix: str = "",
    ) -> None:
        camera_json = json.dumps(node.camera.to_json(), sort_keys=True)
        if camera_json not in self._camera_ids:
            self._camera_ids[camera_json] = len(self._camera_ids) + 1
            self._insert("cameras", self._camera_ids[camera_json], camera_json)
        s = node.summary
        owner = s.of_node if prefix else session_ids.get(s.recording, s.session_id)
        row = (
            s.node_id,
            owner,
            s.name,
            s.t_ns,
            self._camera_ids[camera_json],
            _pose_to_bytes(s.world_from_cam),
            len(node.features),
        )
        self._insert(f"{prefix}nodes", *row)
        self._insert_points(node, kind, blobs, prefix)

    def _insert_points(
        self, node: TopoNode, kind: str, blobs: _PointBlobs, prefix: str = ""
    ) -> None:
        (of_points, of_sums), f, node_id = blobs, node.features, node.summary.node_id
        self._insert(
            f"{prefix}node_points", node_id, kind, len(f), f.descriptors.shape[1], *of_points
        )
        if not prefix:
            for session_statistics, blob in zip(node.session_statistics, of_sums, strict=True):
                self._insert(
                    "landmark_sums",
                    node_id,
                    kind,
                    session_statistics.session_id,
                    len(session_statistics.rows),
                    blob,
                )

    def _insert_model(self, model: CoarseModel, prefix: str = "") -> None:
        self._insert(
            f"{prefix}coarse_models",
            model.name,
            json.dumps(model.settings, sort_keys=True),
            _arrays_bytes(model.arrays),
        )

    def _insert(self, table: str, *row: Any) -> None:
        checksum = compute_checksum(table, row)
        self._database.execute(
            f"INSERT INTO {table} VALUES ({', '.join('?' * (len(row) + 1))})", (*row, checksum)
        )
        names = list(TABLES[table])
        self._checksums[table].append(
            (tuple(row[names.index(name)] for name in SORT_COLUMNS[table].split(", ")), checksum)
        )


def _encode_nodes(nodes: Sequence[tuple[TopoNode, str]]) -> list[tuple[TopoNode, str, _PointBlobs]]:
    """Encode points and statistics of nodes by feature type. Several threads may do so in
    parallel."""
    return [
        (
            node,
            kind,
            (
                [compress_array(a) for a in node_to_arrays(node, kind)],
                [
                    encode_statistics(session_statistics)
                    for session_statistics in node.session_statistics
                ],
            ),
        )
        for node, kind in nodes
    ]


def copy_sorted_tables(database: sqlite3.Connection, path: Path) -> None:
    """Write the tables of a map, each sorted, to the empty file `path`.

    The same rows give byte-identical files for any order of insertion. So an edit can be undone
    exactly.
    """
    database.execute("ATTACH ? AS file", (str(path),))
    # nobody uses the file before it is renamed, so no journal is needed
    for pragma in (
        f"page_size = {_PAGE_BYTES}",
        "journal_mode = OFF",
        "synchronous = OFF",
        f"application_id = {APPLICATION_ID}",
    ):
        database.execute(f"PRAGMA file.{pragma}")
    database.execute(f"PRAGMA file.user_version = {SCHEMA_VERSION}")
    database.execute("BEGIN")
    for table in TABLES:
        database.execute(
            create_table_statement(table).replace("CREATE TABLE ", "CREATE TABLE file.", 1)
        )
        database.execute(
            f"INSERT INTO file.{table} SELECT * FROM main.{table} ORDER BY {SORT_COLUMNS[table]}"
        )
    database.execute("COMMIT")
    database.execute("DETACH file")


def compute_map_digest(checksums: Mapping[str, Sequence[bytes]]) -> str:
    """Return the digest of a map, from the checksums of all rows by table, without the row of the
    digest."""
    digest = blake2b(digest_size=16)
    for table in TABLES:
        digest.update(f"{table} {len(checksums[table])}\n".encode() + b"".join(checksums[table]))
    return digest.hexdigest()


def _session_to_json(session: Session) -> str:
    facts = {
        name: value
        for name, value in asdict(session).items()
        if name not in ("session_id", "name") and value is not None
    }
    if session.camera is not None:
        facts["camera"] = session.camera.to_json()
    return json.dumps(facts, sort_keys=True)


def _pose_to_bytes(world_from_cam: Rigid3) -> bytes:
    return world_from_cam.matrix()[:3].astype("<f8").tobytes()


def _arrays_bytes(arrays: Mapping[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **dict(arrays))  # pyright: ignore[reportArgumentType]
    return buffer.getvalue()
