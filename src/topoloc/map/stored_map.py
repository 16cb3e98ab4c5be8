"""The map file opened: its nodes, images and coarse localizers are read one by one, when they are asked for."""

from __future__ import annotations

import io
import json
import math
import sqlite3
import threading
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np

from topoloc.errors import MapError, TopolocError
from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.map.storage import SIDE, check_header
from topoloc.map.topomap import Edge, NodeSummary, PlaceImage, SharedErrors, SideNodes, TopoMetricMap, TopoNode
from topoloc.places.coarse import CoarseModel

T = TypeVar("T")


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
            sides=_sides_of(file) if file.has_table(f"{SIDE}nodes") else None,
        )


def _sides_of(file: _MapFile) -> SideNodes:
    nodes = _StoredRows(file, f"{SIDE}nodes", lambda k: file.read_node(k, SIDE))
    return SideNodes(_StoredSummaries(file, SIDE), nodes, _StoredModels(file, SIDE))


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

    def has_table(self, table: str) -> bool:
        query = "SELECT COUNT(*) FROM sqlite_master WHERE type = 'table' AND name = ?"
        return self.database.execute(query, (table,)).fetchone()[0] > 0

    def read_node(self, node_id: int, prefix: str = "") -> TopoNode:
        """A node; with the prefix `SIDE` a side node, which has no template."""
        template = ("x''", "") if prefix else ("jpeg", " JOIN node_templates USING (node_id)")
        query = (
            "SELECT recording, name, t_ns, world_from_cam, num_points, json, descriptor_size, points_img, shapes, descriptors,"
            f" points_cam, sqrt_covs, {template[0]} FROM {prefix}nodes JOIN cameras USING (camera_id)"
            f" JOIN {prefix}node_points USING (node_id){template[1]} WHERE node_id = ?"
        )
        with self.reading():
            row = self._one_row(query, node_id, f"{prefix}node {node_id}")
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

    def __init__(self, file: _MapFile, prefix: str = "") -> None:
        self._file, self._prefix = file, prefix

    @cached_property
    def _rows(self) -> list[NodeSummary]:
        columns = "node_id, recording, name, t_ns, world_from_cam, num_points"
        query = f"SELECT {columns} FROM {self._prefix}nodes ORDER BY node_id"
        with self._file.reading():
            rows = self._file.database.execute(query)
            return [NodeSummary(i, rec, name, t_ns, _pose_from_bytes(pose), n) for i, rec, name, t_ns, pose, n in rows]

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index):  # type: ignore[override]
        return self._rows[index]


class _StoredModels(Mapping[str, CoarseModel]):
    def __init__(self, file: _MapFile, prefix: str = "") -> None:
        self._file, self._table = file, f"{prefix}coarse_models"

    @cached_property
    def _names(self) -> list[str]:
        with self._file.reading():
            return [name for (name,) in self._file.database.execute(f"SELECT name FROM {self._table} ORDER BY name")]

    def __len__(self) -> int:
        return len(self._names)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __getitem__(self, name: str) -> CoarseModel:
        if name not in self._names:
            raise KeyError(name)
        with self._file.reading():
            row = self._file.database.execute(f"SELECT settings, arrays FROM {self._table} WHERE name = ?", (name,)).fetchone()
            with np.load(io.BytesIO(row[1]), allow_pickle=False) as arrays:
                return CoarseModel(name, json.loads(row[0]), dict(arrays))


def _pose_from_bytes(data: bytes) -> Rigid3:
    matrix = np.frombuffer(data, "<f8").reshape(3, 4)
    if not np.isfinite(matrix).all():
        raise ValueError("a pose that is not finite")
    return Rigid3(matrix[:, :3].copy(), matrix[:, 3].copy())
