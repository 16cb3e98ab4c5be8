"""Write maps of schema 2: the current tables, with uncompressed arrays of points."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

from mutations import forge

from topoloc.mapping.storage.point_encoding import node_to_arrays
from topoloc.mapping.topomap import TopoMetricMap


def write_schema_2(topomap: TopoMetricMap, path: Path) -> Path:
    topomap.save(path)
    with closing(sqlite3.connect(path, isolation_level=None)) as database:
        database.execute("PRAGMA user_version = 2")
        for prefix, nodes in (
            ("", topomap.nodes),
            ("side_", topomap.sides.nodes if topomap.sides else []),
        ):
            for node in nodes:
                blobs = [array.tobytes() for array in node_to_arrays(node, topomap.kind)]
                columns = (
                    "points_img = ?, shapes = ?, descriptors = ?, points_cam = ?, sqrt_covs = ?"
                )
                database.execute(
                    f"UPDATE {prefix}node_points SET {columns} WHERE node_id = ?",
                    (*blobs, node.summary.node_id),
                )
        forge(database)
    return path
