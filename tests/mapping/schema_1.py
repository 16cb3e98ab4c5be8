"""Write maps of schema 1 in plain SQL, as versions before sessions and checksums did."""

from __future__ import annotations

import io
import json
import sqlite3
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from topoloc.mapping.storage.entries import TopoNode
from topoloc.mapping.storage.map_writing import _pose_to_bytes
from topoloc.mapping.storage.point_encoding import node_to_arrays
from topoloc.mapping.storage.schema import APPLICATION_ID, SCHEMA_1, VIRTUAL_PREFIX
from topoloc.mapping.topomap import TopoMetricMap


def write_schema_1(topomap: TopoMetricMap, path: Path) -> Path:
    with closing(sqlite3.connect(path)) as database:
        database.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        database.execute("PRAGMA user_version = 1")
        for table, creation in SCHEMA_1.items():
            if topomap.sides is not None or not table.startswith(VIRTUAL_PREFIX):
                database.execute(creation)
        facts = {
            "config": asdict(topomap.config),
            "length_m": topomap.length_m,
            "default_coarse": topomap.default_coarse,
        }
        if topomap.first_layer.shared_errors is not None:
            facts["shared_errors"] = asdict(topomap.first_layer.shared_errors)
        database.executemany(
            "INSERT INTO map VALUES (?, ?)",
            [(key, json.dumps(value)) for key, value in facts.items()],
        )
        for node in topomap.nodes:
            _insert(database, node, "")
            database.execute(
                "INSERT INTO node_templates VALUES (?, ?)",
                (node.summary.node_id, node.template_image),
            )
        database.executemany(
            "INSERT INTO edges VALUES (?, ?)",
            [(edge.source_id, edge.target_id) for edge in topomap.edges],
        )
        images = [
            (i.recording, i.name, i.node_id, _pose_to_bytes(i.world_from_cam), i.jpeg)
            for i in topomap.place_images
        ]
        database.executemany(
            "INSERT INTO place_images (recording, name, node_id, world_from_cam, jpeg) VALUES (?,"
            " ?, ?, ?, ?)",
            images,
        )
        models = [("", model) for model in topomap.first_layer.coarse_models.values()]
        if topomap.sides is not None:
            for node in topomap.sides.nodes:
                _insert(database, node, VIRTUAL_PREFIX)
            models += [(VIRTUAL_PREFIX, model) for model in topomap.sides.coarse_models.values()]
        for prefix, model in models:
            row = (
                model.name,
                json.dumps(dict(model.settings), sort_keys=True),
                _npz(dict(model.arrays)),
            )
            database.execute(f"INSERT INTO {prefix}coarse_models VALUES (?, ?, ?)", row)
        database.commit()
    return path


def _insert(database: sqlite3.Connection, node: TopoNode, prefix: str) -> None:
    camera, s, f = json.dumps(node.camera.to_json(), sort_keys=True), node.summary, node.features
    database.execute("INSERT OR IGNORE INTO cameras (json) VALUES (?)", (camera,))
    (camera_id,) = database.execute(
        "SELECT camera_id FROM cameras WHERE json = ?", (camera,)
    ).fetchone()
    row = (
        s.node_id,
        s.recording,
        s.name,
        s.t_ns,
        camera_id,
        _pose_to_bytes(s.world_from_cam),
        len(f),
    )
    database.execute(f"INSERT INTO {prefix}nodes VALUES (?, ?, ?, ?, ?, ?, ?)", row)
    row = (
        s.node_id,
        f.descriptors.shape[1],
        *(array.tobytes() for array in node_to_arrays(node, "surf")),
    )
    database.execute(f"INSERT INTO {prefix}node_points VALUES (?, ?, ?, ?, ?, ?, ?)", row)


def _npz(arrays: dict[str, Any]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()
