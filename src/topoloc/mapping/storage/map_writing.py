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
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import asdict, replace
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from topoloc.compiled import parallel_map
from topoloc.errors import MapError
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.landmark_statistics import encode_statistics
from topoloc.mapping.storage.entries import Session, TopoNode
from topoloc.mapping.storage.kept_files import (
    WaitCallback,
    drop_kept_files,
    keep_file,
    lock_map_file,
)
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
from topoloc.mapping.validation import describe_failure, sqlite_failures_as_os_errors
from topoloc.recordings.atomic import atomic_write, fsync
from topoloc.retrieval.coarse import CoarseModel

if TYPE_CHECKING:
    from topoloc.mapping.topomap import TopoMetricMap

_PAGE_BYTES = 1024
"""A row leaves half of its last page empty on average, and a node has about eight rows. Larger
pages cost 1 to 5 kB more per node."""


def save_map(
    topomap: TopoMetricMap,
    path: Path,
    on_wait: WaitCallback | None = None,
    is_old_kept: bool = True,
) -> None:
    """Write the map to `path` atomically. A reader sees the old map or the new one. A file that is
    replaced is kept, if `is_old_kept`. Waits while another process edits the map at `path`, and
    calls `on_wait` once before.

    Raises:
        MapError: the folder does not exist or cannot be written, the disk is full, or this thread
            edits the map at `path`. Nothing is left behind.
    """
    if os.path.isdir(path):  # Path.is_dir raises an error for names that are too long
        raise MapError(f"cannot write map {path}: it is a folder")
    with ExitStack() as stack:
        if os.path.isfile(path):
            with suppress(OSError):  # it cannot be read, so nobody edits it
                stack.enter_context(lock_map_file(path, on_wait))
        replace_file(topomap, path, is_old_kept)


def replace_file(
    topomap: TopoMetricMap,
    path: Path,
    is_old_kept: bool = True,
    check: Callable[[], None] = lambda: None,
) -> Sequence[Path]:
    """Write the map to `path` atomically, after `check`. Return the files that are kept of it now,
    the newest first. Raises MapError, which leaves nothing behind."""
    kept, place = None, path
    try:
        place = Path(os.path.realpath(path))
        with atomic_write(path) as temporary:
            write_map(topomap, temporary)
            fsync(temporary)  # takes long, so it comes before the check
            if is_old_kept and os.path.isfile(path):
                kept = keep_file(place, temporary)
            check()
    except (OSError, ValueError, MapError) as error:
        if kept is not None:
            kept.unlink(missing_ok=True)
        # a null character in the name; any other ValueError is a bug
        is_bug = isinstance(error, ValueError) and "null" not in str(error)
        if is_bug or isinstance(error, MapError):
            raise
        raise MapError(f"cannot write map {path}: {describe_failure(error)}") from error
    return [] if kept is None else drop_kept_files(place, kept)


def write_map(topomap: TopoMetricMap, path: Path) -> None:
    """Write the map to the empty file `path`. Raises OSError if the disk is full."""
    # an empty name creates a private temporary database, removed at closing
    with (
        sqlite_failures_as_os_errors(),
        closing(sqlite3.connect("", isolation_level=None)) as database,
    ):
        _Writer(database).write(topomap)
        copy_sorted_tables(database, path)


class _Writer:
    """Insert rows with checksums and count them. The table `map` is written last, with the counts
    and the digest."""

    def __init__(self, database: sqlite3.Connection) -> None:
        self._database = database
        self._checksums: dict[str, list[tuple[tuple[Any, ...], bytes]]] = {
            table: [] for table in TABLES
        }
        self._camera_ids: dict[str, int] = {}
        self._session_ids: dict[str, int] = {}

    def write(self, topomap: TopoMetricMap) -> None:
        """Write all tables of the map in one transaction. The sessions of a map without sessions
        are those that its entries name."""
        self._database.execute("PRAGMA journal_mode = OFF")
        self._database.execute("BEGIN")
        for table in TABLES:
            self._database.execute(create_table_statement(table))
        if not topomap.sessions:
            names = [entry.recording for entry in (*topomap.summaries, *topomap.place_images)]
            sessions = [Session(number, name) for number, name in enumerate(dict.fromkeys(names))]
            topomap = replace(topomap, sessions=sessions)
            self._session_ids = {one.name: one.session_id for one in topomap.sessions}
        for session in topomap.sessions:
            self._insert("sessions", session.session_id, session.name, _session_to_json(session))
        for edit in topomap.edits:
            self._insert("edits", edit.edit_id, edit.name, edit.date, edit.schema)
        self._write_nodes(
            [(topomap.layers[kind].nodes[row], kind) for kind in topomap.kinds]
            for row in range(len(topomap.nodes))
        )
        for edge in sorted(topomap.edges):
            self._insert("edges", edge.source_id, edge.target_id)
        next_image = self._write_images(topomap)
        for kind, layer in topomap.layers.items():
            self._write_models(layer.coarse_models, "", layer_suffix(kind, topomap.kind))
        if topomap.sides is not None:
            kind = topomap.sides.kind
            self._write_nodes(([(node, kind)] for node in topomap.sides.nodes), VIRTUAL_PREFIX)
            self._write_models(topomap.sides.coarse_models, VIRTUAL_PREFIX)
        for text, camera_id in self._camera_ids.items():
            self._insert("cameras", camera_id, text)
        if topomap.repetitions is not None:
            for node_id, moves in sorted(topomap.repetitions.moves.items()):
                blob = moves[:, :3].astype("<f8").tobytes()
                self._insert("repetitions", node_id, len(moves), blob)
        self._write_metadata(topomap, next_image)
        self._database.execute("COMMIT")

    def _write_nodes(
        self, nodes: Iterable[Sequence[tuple[TopoNode, str]]], prefix: str = ""
    ) -> None:
        """Write nodes, each given with its points of all feature types, the first type first."""
        for node, rows in parallel_map(_encode_node, nodes):
            s = node.summary
            camera = json.dumps(node.camera.to_json(), sort_keys=True)
            camera_id = self._camera_ids.setdefault(camera, len(self._camera_ids) + 1)
            owner = s.of_node if prefix else self._session_ids.get(s.recording, s.session_id)
            pose, num_points = _pose_to_bytes(s.world_from_cam), len(node.features)
            self._insert(
                f"{prefix}nodes", s.node_id, owner, s.name, s.t_ns, camera_id, pose, num_points
            )
            if not prefix:
                self._insert("node_templates", s.node_id, node.template_image)
            for table, *row in rows:
                self._insert(f"{prefix}{table}", *row)

    def _write_images(self, topomap: TopoMetricMap) -> int:
        """Write the images. Images without an id receive the next ones. Return the id after the
        last."""
        next_id = max(topomap.next_ids.place_image, 1)
        for image in topomap.place_images:
            image_id = next_id if image.image_id is None else image.image_id
            self._insert(
                "place_images",
                image_id,
                self._session_ids.get(image.recording, image.session_id),
                image.name,
                image.node_id,
                _pose_to_bytes(image.world_from_cam),
                image.jpeg,
            )
            next_id = max(next_id, image_id + 1)
        return next_id

    def _write_metadata(self, topomap: TopoMetricMap, next_image: int) -> None:
        of_sides = topomap.sides.summaries if topomap.sides else ()
        side_node = max([topomap.next_ids.side_node, *(side.node_id + 1 for side in of_sides)])
        next_ids = replace(topomap.free_ids, place_image=next_image, side_node=side_node)
        counts = {table: len(rows) for table, rows in self._checksums.items() if table != "map"}
        facts = {
            "config": json.dumps(topomap.config.to_json(), sort_keys=True),
            "kinds": json.dumps(topomap.kinds),
            "length_m": json.dumps(topomap.length_m),
            "default_coarse": json.dumps(topomap.default_coarse),
            "next_ids": json.dumps(asdict(next_ids)),
            "counts": json.dumps(counts),
            "map_id": topomap.id,
        }
        changes = {str(edit.edit_id): dict(edit.changes) for edit in topomap.edits if edit.changes}
        optional = {
            "changes": changes or None,
            "kind_of_sides": topomap.sides and topomap.sides.kind,
            "georeference": topomap.georeference and topomap.georeference.to_json(),
            "certificate": topomap.certificate and topomap.certificate.to_json(),
        }
        facts |= {key: json.dumps(value) for key, value in optional.items() if value is not None}
        for kind, layer in topomap.layers.items():
            if layer.shared_errors is not None:
                key = f"shared_errors{layer_suffix(kind, topomap.kind)}"
                facts[key] = json.dumps(asdict(layer.shared_errors))
        if topomap.repetitions is not None:
            facts["repetitions"] = topomap.repetitions.digest
        for key, value in sorted(facts.items()):
            self._insert("map", key, value)
        checksums = {table: [c for _, c in sorted(rows)] for table, rows in self._checksums.items()}
        self._insert("map", "digest", compute_map_digest(checksums))

    def _write_models(
        self, models: Mapping[str, CoarseModel], prefix: str, suffix: str = ""
    ) -> None:
        for model in models.values():
            buffer, arrays = io.BytesIO(), dict[str, Any](model.arrays)
            np.savez(buffer, **arrays)
            settings = json.dumps(model.settings, sort_keys=True)
            self._insert(f"{prefix}coarse_models", model.name + suffix, settings, buffer.getvalue())

    def _insert(self, table: str, *row: Any) -> None:
        checksum = compute_checksum(table, row)
        self._database.execute(
            f"INSERT INTO {table} VALUES ({', '.join('?' * (len(row) + 1))})", (*row, checksum)
        )
        named = dict(zip(TABLES[table], row, strict=True))
        key = tuple(named[name] for name in SORT_COLUMNS[table].split(", "))
        self._checksums[table].append((key, checksum))


def _encode_node(
    of_types: Sequence[tuple[TopoNode, str]],
) -> tuple[TopoNode, list[tuple[Any, ...]]]:
    """Return a node with its points of the first feature type, and the rows of its points and
    statistics of all types, each with its table first. Several threads may encode nodes."""
    rows = list[tuple[Any, ...]]()
    for node, kind in of_types:
        node_id, num_points = node.summary.node_id, len(node.features)
        blobs = [compress_array(array) for array in node_to_arrays(node, kind)]
        size = node.features.descriptors.shape[1]
        rows.append(("node_points", node_id, kind, num_points, size, *blobs))
        rows += [
            ("landmark_sums", node_id, kind, one.session_id, len(one.rows), sums)
            for one in node.session_statistics
            for sums in [encode_statistics(one, node.point_sqrt_covs)]
        ]
    return of_types[0][0], rows


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
        f"user_version = {SCHEMA_VERSION}",
    ):
        database.execute(f"PRAGMA file.{pragma}")
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
