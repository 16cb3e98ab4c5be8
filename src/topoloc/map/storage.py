"""The map file: one SQLite database, written atomically (see docs/map-format.md); `stored_map.py` opens it.

A node costs about 100 bytes a point and a small JPEG: descriptors are kept as signed bytes, covariances as half floats
of their square root, pixels and positions as single floats.
"""

from __future__ import annotations

import io
import json
import os
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path

import numpy as np

from topoloc.errors import MapError, MapVersionError
from topoloc.geometry.rigid import Rigid3
from topoloc.map.topomap import SideNodes, TopoMetricMap, TopoNode
from topoloc.places.coarse import CoarseModel

APPLICATION_ID = 0x544F504F  # "TOPO", in the database's header
SCHEMA_VERSION = 1
DESCRIPTOR_SCALE = 200.0  # components of unit descriptors stay below 127 / 200 = 0.63 but for rare spikes, which are clipped

_SCHEMA = """
CREATE TABLE map (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE cameras (camera_id INTEGER PRIMARY KEY, json TEXT NOT NULL UNIQUE);
CREATE TABLE node_templates (node_id INTEGER PRIMARY KEY REFERENCES nodes, jpeg BLOB NOT NULL);
CREATE TABLE edges (source_id INTEGER NOT NULL REFERENCES nodes, target_id INTEGER NOT NULL REFERENCES nodes);
CREATE TABLE place_images (image_id INTEGER PRIMARY KEY, recording TEXT NOT NULL, name TEXT NOT NULL,
    node_id INTEGER NOT NULL REFERENCES nodes, world_from_cam BLOB NOT NULL, jpeg BLOB NOT NULL);
"""
# Of the map's nodes, and once more of its side nodes, where it has any.
_NODE_TABLES = """
CREATE TABLE {prefix}nodes (node_id INTEGER PRIMARY KEY, recording TEXT NOT NULL, name TEXT NOT NULL, t_ns INTEGER NOT NULL,
    camera_id INTEGER NOT NULL REFERENCES cameras, world_from_cam BLOB NOT NULL, num_points INTEGER NOT NULL);
CREATE TABLE {prefix}node_points (node_id INTEGER PRIMARY KEY REFERENCES {prefix}nodes, descriptor_size INTEGER NOT NULL,
    points_img BLOB NOT NULL, shapes BLOB NOT NULL, descriptors BLOB NOT NULL, points_cam BLOB NOT NULL, sqrt_covs BLOB NOT NULL);
CREATE TABLE {prefix}coarse_models (name TEXT PRIMARY KEY, settings TEXT NOT NULL, arrays BLOB NOT NULL);
"""
SIDE = "side_"


def save_map(topomap: TopoMetricMap, path: Path) -> None:
    """Write the map to `path`: beside it first, then renamed over it, so that a reader sees the old map or the new one.

    Raises:
        MapError: the folder does not exist or cannot be written, or the disk is full; nothing is left behind.
    """
    if os.path.isdir(path):  # Path.is_dir raises for names that are too long
        raise MapError(f"cannot write map {path}: it is a folder")
    with replaced_file(path) as temporary:
        _write_database(topomap, temporary)


@contextmanager
def replaced_file(path: Path) -> Iterator[Path]:
    """A name beside `path` to write to; what was written there is renamed over `path` when all went well.

    Raises:
        MapError: it could not be written; nothing is left behind.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield temporary
        os.replace(temporary, path)
    except (sqlite3.Error, OSError) as error:
        raise MapError(f"cannot write map {path}: {error}") from error
    finally:
        for leftover in (temporary, temporary.with_name(temporary.name + "-journal")):
            with suppress(OSError):  # not there, or its folder is no folder: the error that led here says more
                leftover.unlink()


def _write_database(topomap: TopoMetricMap, path: Path) -> None:
    path.unlink(missing_ok=True)
    database = sqlite3.connect(path)
    try:
        database.execute("PRAGMA page_size = 4096")
        database.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        database.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
        database.executescript(_NODE_TABLES.format(prefix="") + _SCHEMA)
        info = {"config": json.dumps(topomap.config, sort_keys=True), "length_m": json.dumps(topomap.length_m)}
        info["default_coarse"] = json.dumps(topomap.default_coarse)
        if topomap.shared_errors is not None:
            info["shared_errors"] = json.dumps(asdict(topomap.shared_errors))
        database.executemany("INSERT INTO map VALUES (?, ?)", info.items())
        for node in topomap.nodes:
            _insert_node(database, node)
            database.execute("INSERT INTO node_templates VALUES (?, ?)", (node.summary.node_id, node.template_jpeg))
        database.executemany("INSERT INTO edges VALUES (?, ?)", ((e.source_id, e.target_id) for e in topomap.edges))
        rows = ((p.recording, p.name, p.node_id, _pose_bytes(p.world_from_cam), p.jpeg) for p in topomap.place_images)
        database.executemany("INSERT INTO place_images (recording, name, node_id, world_from_cam, jpeg) VALUES (?, ?, ?, ?, ?)", rows)
        for model in topomap.coarse_models.values():
            insert_model(database, model)
        if topomap.sides is not None:
            _insert_sides(database, topomap.sides)
        database.commit()
    finally:
        database.close()


def _insert_sides(database: sqlite3.Connection, sides: SideNodes) -> None:
    database.executescript(_NODE_TABLES.format(prefix=SIDE))
    for node in sides.nodes:
        _insert_node(database, node, SIDE)
    for model in sides.coarse_models.values():
        insert_model(database, model, SIDE)


def _insert_node(database: sqlite3.Connection, node: TopoNode, prefix: str = "") -> None:
    camera_json = json.dumps(node.camera.to_json(), sort_keys=True)
    database.execute("INSERT OR IGNORE INTO cameras (json) VALUES (?)", (camera_json,))
    (camera_id,) = database.execute("SELECT camera_id FROM cameras WHERE json = ?", (camera_json,)).fetchone()
    s = node.summary
    row = (s.node_id, s.recording, s.name, s.t_ns, camera_id, _pose_bytes(s.world_from_cam), len(node.features))
    database.execute(f"INSERT INTO {prefix}nodes VALUES (?, ?, ?, ?, ?, ?, ?)", row)
    f = node.features
    quantised = np.clip(np.rint(f.descriptors * DESCRIPTOR_SCALE), -127, 127).astype(np.int8)
    shapes = np.stack([f.sizes_px, f.angles, f.responses], axis=1).astype("<f4")
    blobs = (f.points_img.astype("<f4"), shapes, quantised, node.points_cam.astype("<f4"), node.point_sqrt_covs.astype("<f2"))
    row = (s.node_id, f.descriptors.shape[1], *(blob.tobytes() for blob in blobs))
    database.execute(f"INSERT INTO {prefix}node_points VALUES (?, ?, ?, ?, ?, ?, ?)", row)


def insert_model(database: sqlite3.Connection, model: CoarseModel, prefix: str = "") -> None:
    """Add a coarse localizer, or put it in the place of the one of its name."""
    row = (model.name, json.dumps(model.settings, sort_keys=True), _arrays_bytes(model.arrays))
    database.execute(f"INSERT OR REPLACE INTO {prefix}coarse_models VALUES (?, ?, ?)", row)


def check_header(path: Path) -> None:
    """The 100 bytes that every SQLite file begins with: is it one, is it ours, is it whole, is it of our schema?"""
    try:
        with path.open("rb") as file:
            header = file.read(100)
            num_bytes = file.seek(0, os.SEEK_END)
    except OSError as error:
        raise MapError(f"cannot open map {path}: {error.strerror}") from error
    if len(header) < 100 or not header.startswith(b"SQLite format 3\0"):
        raise MapError(f"{path} is not a topoloc map" + (" (the file is empty)" if num_bytes == 0 else ""))
    if int.from_bytes(header[68:72], "big") != APPLICATION_ID:
        raise MapError(f"{path} is an SQLite database but not a topoloc map")
    version = int.from_bytes(header[60:64], "big")
    if version != SCHEMA_VERSION:
        newer = "a newer topoloc" if version > SCHEMA_VERSION else "an older topoloc; build it again"
        raise MapVersionError(f"map {path} has schema {version}, this topoloc reads schema {SCHEMA_VERSION}: written by {newer}")
    page_size = int.from_bytes(header[16:18], "big")
    expected = int.from_bytes(header[28:32], "big") * (65536 if page_size == 1 else page_size)
    if num_bytes < expected:
        raise MapError(f"map {path} is truncated: {num_bytes} of {expected} bytes")


def _pose_bytes(world_from_cam: Rigid3) -> bytes:
    return world_from_cam.matrix()[:3].astype("<f8").tobytes()


def _arrays_bytes(arrays: Mapping[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **dict(arrays))  # pyright: ignore[reportArgumentType]
    return buffer.getvalue()
