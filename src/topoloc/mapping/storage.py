"""The map file: one SQLite database, written atomically, opened lazily (see docs/map-format.md).

A node costs about 100 bytes a point and a small JPEG: descriptors are kept as signed bytes, covariances as half floats
of their square root, pixels and positions as single floats.
"""

from __future__ import annotations

import io
import json
import math
import os
import sqlite3
import threading
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np

from topoloc.errors import MapError, MapVersionError, TopolocError
from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.topomap import Edge, NodeSummary, PlaceImage, SharedErrors, TopoMetricMap, TopoNode
from topoloc.places.coarse import CoarseModel

APPLICATION_ID = 0x544F504F  # "TOPO", in the database's header
SCHEMA_VERSION = 1
DESCRIPTOR_SCALE = 200.0  # components of unit descriptors stay below 127 / 200 = 0.63 but for rare spikes, which are clipped

_SCHEMA = """
CREATE TABLE map (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE cameras (camera_id INTEGER PRIMARY KEY, json TEXT NOT NULL UNIQUE);
CREATE TABLE nodes (node_id INTEGER PRIMARY KEY, recording TEXT NOT NULL, name TEXT NOT NULL, t_ns INTEGER NOT NULL,
    camera_id INTEGER NOT NULL REFERENCES cameras, world_from_cam BLOB NOT NULL, num_points INTEGER NOT NULL);
CREATE TABLE node_points (node_id INTEGER PRIMARY KEY REFERENCES nodes, descriptor_size INTEGER NOT NULL, points_img BLOB NOT NULL,
    shapes BLOB NOT NULL, descriptors BLOB NOT NULL, points_cam BLOB NOT NULL, sqrt_covs BLOB NOT NULL);
CREATE TABLE node_templates (node_id INTEGER PRIMARY KEY REFERENCES nodes, jpeg BLOB NOT NULL);
CREATE TABLE edges (source_id INTEGER NOT NULL REFERENCES nodes, target_id INTEGER NOT NULL REFERENCES nodes);
CREATE TABLE place_images (image_id INTEGER PRIMARY KEY, recording TEXT NOT NULL, name TEXT NOT NULL,
    node_id INTEGER NOT NULL REFERENCES nodes, world_from_cam BLOB NOT NULL, jpeg BLOB NOT NULL);
CREATE TABLE coarse_models (name TEXT PRIMARY KEY, settings TEXT NOT NULL, arrays BLOB NOT NULL);
"""

T = TypeVar("T")


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
        database.executescript(_SCHEMA)
        info = {"config": json.dumps(topomap.config, sort_keys=True), "length_m": json.dumps(topomap.length_m)}
        info["default_coarse"] = json.dumps(topomap.default_coarse)
        if topomap.shared_errors is not None:
            info["shared_errors"] = json.dumps(asdict(topomap.shared_errors))
        database.executemany("INSERT INTO map VALUES (?, ?)", info.items())
        for node in topomap.nodes:
            _insert_node(database, node)
        database.executemany("INSERT INTO edges VALUES (?, ?)", ((e.source_id, e.target_id) for e in topomap.edges))
        rows = ((p.recording, p.name, p.node_id, _pose_bytes(p.world_from_cam), p.jpeg) for p in topomap.place_images)
        database.executemany("INSERT INTO place_images (recording, name, node_id, world_from_cam, jpeg) VALUES (?, ?, ?, ?, ?)", rows)
        for model in topomap.coarse_models.values():
            insert_model(database, model)
        database.commit()
    finally:
        database.close()


def _insert_node(database: sqlite3.Connection, node: TopoNode) -> None:
    camera_json = json.dumps(node.camera.to_json(), sort_keys=True)
    database.execute("INSERT OR IGNORE INTO cameras (json) VALUES (?)", (camera_json,))
    (camera_id,) = database.execute("SELECT camera_id FROM cameras WHERE json = ?", (camera_json,)).fetchone()
    s = node.summary
    row = (s.node_id, s.recording, s.name, s.t_ns, camera_id, _pose_bytes(s.world_from_cam), len(node.features))
    database.execute("INSERT INTO nodes VALUES (?, ?, ?, ?, ?, ?, ?)", row)
    f = node.features
    quantised = np.clip(np.rint(f.descriptors * DESCRIPTOR_SCALE), -127, 127).astype(np.int8)
    shapes = np.stack([f.sizes_px, f.angles, f.responses], axis=1).astype("<f4")
    blobs = (f.points_img.astype("<f4"), shapes, quantised, node.points_cam.astype("<f4"), node.point_sqrt_covs.astype("<f2"))
    database.execute(
        "INSERT INTO node_points VALUES (?, ?, ?, ?, ?, ?, ?)", (s.node_id, f.descriptors.shape[1], *(blob.tobytes() for blob in blobs))
    )
    database.execute("INSERT INTO node_templates VALUES (?, ?)", (s.node_id, node.template_jpeg))


def insert_model(database: sqlite3.Connection, model: CoarseModel) -> None:
    """Add a coarse localizer, or put it in the place of the one of its name."""
    row = (model.name, json.dumps(model.settings, sort_keys=True), _arrays_bytes(model.arrays))
    database.execute("INSERT OR REPLACE INTO coarse_models VALUES (?, ?, ?)", row)


def open_map(path: Path) -> TopoMetricMap:
    """Open a map file without reading its nodes.

    Raises:
        MapError: missing, no topoloc map, or truncated.
        MapVersionError: written with another schema.
    """
    file = _MapFile(path)
    with file.reading():
        info = dict(file.database.execute("SELECT key, value FROM map"))
        return TopoMetricMap(
            summaries=_StoredSummaries(file),
            nodes=_StoredRows(file, "nodes", file.read_node),
            edges=[Edge(*row) for row in file.database.execute("SELECT source_id, target_id FROM edges ORDER BY rowid")],
            place_images=_StoredRows(file, "place_images", file.read_place_image),
            coarse_models=_StoredModels(file),
            config=json.loads(info["config"]),
            length_m=float(json.loads(info["length_m"])),
            default_coarse=json.loads(info.get("default_coarse", '"surf-vlad"')),
            shared_errors=_shared_errors_of(info),
        )


def _shared_errors_of(info: Mapping[str, str]) -> SharedErrors | None:
    if "shared_errors" not in info:
        return None
    facts = json.loads(info["shared_errors"])
    if not 0.0 <= facts["rho"] < math.inf:
        raise ValueError("shared errors that are no share")
    return SharedErrors(float(facts["rho"]), str(facts["digest"]))


# What SQLite, JSON, NumPy, its zip container and the types of this house say about bytes that are not what they should be.
_NUMPY_FILE_ERRORS = (zipfile.BadZipFile, zlib.error, EOFError, OSError)
_DAMAGE = (*_NUMPY_FILE_ERRORS, sqlite3.Error, ValueError, LookupError, TypeError, ArithmeticError, TopolocError)


class _MapFile:
    """The open database; one reader at a time, since a query server may call from several threads."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.lock = threading.RLock()
        check_header(path)
        # The file is never changed in place, so SQLite needs no locks on it (and works on read-only media).
        with self.reading():
            self.database = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True, check_same_thread=False)

    @contextmanager
    def reading(self) -> Iterator[None]:
        try:
            with self.lock:
                yield
        except MapError:
            raise
        except _DAMAGE as error:
            raise MapError(f"map {self.path} is damaged: {' '.join(str(error).split())}") from error

    def count(self, table: str) -> int:
        with self.reading():
            return int(self.database.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])

    def read_node(self, node_id: int) -> TopoNode:
        query = (
            "SELECT recording, name, t_ns, world_from_cam, num_points, json, descriptor_size, points_img, shapes, descriptors,"
            " points_cam, sqrt_covs, jpeg FROM nodes JOIN cameras USING (camera_id) JOIN node_points USING (node_id)"
            " JOIN node_templates USING (node_id) WHERE node_id = ?"
        )
        with self.reading():
            row = self._one_row(query, node_id, f"node {node_id}")
            recording, name, t_ns, pose, num_points, camera, descriptor_size, *blobs, jpeg = row
            points_img = np.frombuffer(blobs[0], "<f4").reshape(num_points, 2)
            sizes, angles, responses = np.ascontiguousarray(np.frombuffer(blobs[1], "<f4").reshape(num_points, 3).T)
            descriptors = np.frombuffer(blobs[2], np.int8).reshape(num_points, descriptor_size).astype(np.float32)
            descriptors /= np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-6)
            return TopoNode(
                NodeSummary(node_id, recording, name, t_ns, _pose_from_bytes(pose), num_points),
                Camera.from_json(json.loads(camera)),
                Features(points_img, sizes, angles, responses, descriptors),
                np.frombuffer(blobs[3], "<f4").reshape(num_points, 3),
                np.frombuffer(blobs[4], "<f2").reshape(num_points, 6).astype(np.float32),
                jpeg,
            )

    def read_place_image(self, row_id: int) -> PlaceImage:
        with self.reading():
            query = "SELECT recording, name, node_id, world_from_cam, jpeg FROM place_images WHERE image_id = ?"
            recording, name, node_id, pose, jpeg = self._one_row(query, row_id + 1, f"place image {row_id}")
            return PlaceImage(recording, name, node_id, _pose_from_bytes(pose), jpeg)

    def _one_row(self, query: str, key: int, what: str) -> tuple:
        row = self.database.execute(query, (key,)).fetchone()
        if row is None:
            raise MapError(f"map {self.path} is damaged: {what} is missing")
        return row


class _StoredRows(Sequence[T]):
    """Rows of one table, numbered from 0, each read when asked for."""

    def __init__(self, file: _MapFile, table: str, read: Callable[[int], T]) -> None:
        self._file, self._table, self._read = file, table, read

    @cached_property
    def _length(self) -> int:
        return self._file.count(self._table)

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, index):  # type: ignore[override]
        if isinstance(index, slice):
            return [self._read(i) for i in range(*index.indices(len(self)))]
        position = index + len(self) if index < 0 else index
        if not 0 <= position < len(self):
            raise IndexError(index)
        return self._read(int(position))


class _StoredSummaries(Sequence[NodeSummary]):
    """The summaries of all nodes, read together at the first question: a few dozen bytes a node."""

    def __init__(self, file: _MapFile) -> None:
        self._file = file

    @cached_property
    def _rows(self) -> list[NodeSummary]:
        query = "SELECT node_id, recording, name, t_ns, world_from_cam, num_points FROM nodes ORDER BY node_id"
        with self._file.reading():
            rows = self._file.database.execute(query)
            return [NodeSummary(i, rec, name, t_ns, _pose_from_bytes(pose), n) for i, rec, name, t_ns, pose, n in rows]

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index):  # type: ignore[override]
        return self._rows[index]


class _StoredModels(Mapping[str, CoarseModel]):
    def __init__(self, file: _MapFile) -> None:
        self._file = file

    @cached_property
    def _names(self) -> list[str]:
        with self._file.reading():
            return [name for (name,) in self._file.database.execute("SELECT name FROM coarse_models ORDER BY name")]

    def __len__(self) -> int:
        return len(self._names)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __getitem__(self, name: str) -> CoarseModel:
        if name not in self._names:
            raise KeyError(name)
        with self._file.reading():
            row = self._file.database.execute("SELECT settings, arrays FROM coarse_models WHERE name = ?", (name,)).fetchone()
            with np.load(io.BytesIO(row[1]), allow_pickle=False) as arrays:
                return CoarseModel(name, json.loads(row[0]), dict(arrays))


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


def _pose_from_bytes(data: bytes) -> Rigid3:
    matrix = np.frombuffer(data, "<f8").reshape(3, 4)
    if not np.isfinite(matrix).all():
        raise ValueError("a pose that is not finite")
    return Rigid3(matrix[:, :3].copy(), matrix[:, 3].copy())


def _arrays_bytes(arrays: Mapping[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **dict(arrays))  # pyright: ignore[reportArgumentType]
    return buffer.getvalue()
