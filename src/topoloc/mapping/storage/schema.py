"""Define the tables of a map file (docs/map-format.md), the checksum of a row, and the views for
older files."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from hashlib import blake2b
from typing import Any

APPLICATION_ID = 0x544F504F  # "TOPO", in the database's header
SCHEMA_VERSION = 4
VIRTUAL_PREFIX = "side_"

Columns = dict[str, str]
_CHECKSUM = "checksum BLOB NOT NULL"
_POINTS: Columns = {
    "kind": "TEXT NOT NULL",
    "num_points": "INTEGER NOT NULL",
    "descriptor_size": "INTEGER NOT NULL",
    "points_img": "BLOB NOT NULL",
    "shapes": "BLOB NOT NULL",
    "descriptors": "BLOB NOT NULL",
    "points_cam": "BLOB NOT NULL",
    "sqrt_covs": "BLOB NOT NULL",
}
_MODEL: Columns = {
    "name": "TEXT PRIMARY KEY",
    "settings": "TEXT NOT NULL",
    "arrays": "BLOB NOT NULL",
}
_NODE: Columns = {
    "name": "TEXT NOT NULL",
    "t_ns": "INTEGER NOT NULL",
    "camera_id": "INTEGER NOT NULL REFERENCES cameras",
    "world_from_cam": "BLOB NOT NULL",
    "num_points": "INTEGER NOT NULL",
}

# table -> column -> SQL declaration. Each row also has the column `checksum`.
TABLES: dict[str, Columns] = {
    "map": {"key": "TEXT PRIMARY KEY", "value": "TEXT NOT NULL"},
    "edits": {
        "edit_id": "INTEGER PRIMARY KEY",
        "name": "TEXT NOT NULL",
        "date": "TEXT NOT NULL",
        "schema": "INTEGER NOT NULL",
    },
    "sessions": {
        "session_id": "INTEGER PRIMARY KEY",
        "name": "TEXT NOT NULL",
        "json": "TEXT NOT NULL",
    },
    "cameras": {"camera_id": "INTEGER PRIMARY KEY", "json": "TEXT NOT NULL UNIQUE"},
    "nodes": {
        "node_id": "INTEGER PRIMARY KEY",
        "session_id": "INTEGER NOT NULL REFERENCES sessions",
        **_NODE,
    },
    "node_points": {"node_id": "INTEGER NOT NULL REFERENCES nodes", **_POINTS},
    "landmark_sums": {
        "node_id": "INTEGER NOT NULL REFERENCES nodes",
        "kind": "TEXT NOT NULL",
        "session_id": "INTEGER NOT NULL REFERENCES sessions",
        "num_rows": "INTEGER NOT NULL",
        "sums": "BLOB NOT NULL",
    },
    "node_templates": {"node_id": "INTEGER PRIMARY KEY REFERENCES nodes", "jpeg": "BLOB NOT NULL"},
    "repetitions": {
        "node_id": "INTEGER PRIMARY KEY REFERENCES nodes",
        "num_moves": "INTEGER NOT NULL",
        "moves": "BLOB NOT NULL",
    },
    "edges": {
        "source_id": "INTEGER NOT NULL REFERENCES nodes",
        "target_id": "INTEGER NOT NULL REFERENCES nodes",
    },
    "place_images": {
        "image_id": "INTEGER PRIMARY KEY",
        "session_id": "INTEGER NOT NULL REFERENCES sessions",
        "name": "TEXT NOT NULL",
        "node_id": "INTEGER NOT NULL REFERENCES nodes",
        "world_from_cam": "BLOB NOT NULL",
        "jpeg": "BLOB NOT NULL",
    },
    "coarse_models": dict(_MODEL),
    "side_nodes": {
        "node_id": "INTEGER PRIMARY KEY",
        "of_node": "INTEGER NOT NULL REFERENCES nodes",
        **_NODE,
    },
    "side_node_points": {"node_id": "INTEGER NOT NULL REFERENCES side_nodes", **_POINTS},
    "side_coarse_models": dict(_MODEL),
}
_CONSTRAINTS = {
    "node_points": "PRIMARY KEY (node_id, kind)",
    "side_node_points": "PRIMARY KEY (node_id, kind)",
    "landmark_sums": "PRIMARY KEY (node_id, kind, session_id)",
    "edges": "PRIMARY KEY (source_id, target_id)",
}
# the columns that sort rows when they are written, read and digested
SORT_COLUMNS = {table: next(iter(columns)) for table, columns in TABLES.items()} | {
    "node_points": "node_id, kind",
    "side_node_points": "node_id, kind",
    "landmark_sums": "node_id, kind, session_id",
    "edges": "source_id, target_id",
}

# the tables of schema 1; those of virtual nodes are optional
SCHEMA_1 = {
    "map": "(key TEXT PRIMARY KEY, value TEXT NOT NULL)",
    "cameras": "(camera_id INTEGER PRIMARY KEY, json TEXT NOT NULL UNIQUE)",
    "node_templates": "(node_id INTEGER PRIMARY KEY REFERENCES nodes, jpeg BLOB NOT NULL)",
    "edges": "(source_id INTEGER NOT NULL REFERENCES nodes,"
    " target_id INTEGER NOT NULL REFERENCES nodes)",
    "place_images": """(image_id INTEGER PRIMARY KEY, recording TEXT NOT NULL, name TEXT NOT NULL,
    node_id INTEGER NOT NULL REFERENCES nodes, world_from_cam BLOB NOT NULL, jpeg BLOB NOT NULL)""",
}
for _prefix in ("", VIRTUAL_PREFIX):
    SCHEMA_1 |= {
        f"{_prefix}nodes": """(node_id INTEGER PRIMARY KEY, recording TEXT NOT NULL, name TEXT NOT NULL, t_ns INTEGER NOT NULL,
    camera_id INTEGER NOT NULL REFERENCES cameras, world_from_cam BLOB NOT NULL, num_points INTEGER NOT NULL)""",  # noqa: E501
        f"{_prefix}node_points": f"""(node_id INTEGER PRIMARY KEY REFERENCES {_prefix}nodes, descriptor_size INTEGER NOT NULL,
    points_img BLOB NOT NULL, shapes BLOB NOT NULL, descriptors BLOB NOT NULL, points_cam BLOB NOT NULL, sqrt_covs BLOB NOT NULL)""",  # noqa: E501
        f"{_prefix}coarse_models": "(name TEXT PRIMARY KEY, settings TEXT NOT NULL, arrays BLOB NOT NULL)",  # noqa: E501
    }
SCHEMA_1 = {table: f"CREATE TABLE {table} {columns}" for table, columns in SCHEMA_1.items()}


def create_table_statement(table: str) -> str:
    """Return the SQL statement that creates a table. A file is read only if its statements are
    identical."""
    declared = [f"{name} {declaration}" for name, declaration in TABLES[table].items()]
    constraint = [_CONSTRAINTS[table]] if table in _CONSTRAINTS else []
    return f"CREATE TABLE {table} ({', '.join([*declared, _CHECKSUM, *constraint])})"


def compute_checksum(table: str, row: Sequence[Any]) -> bytes:
    """Return 8 bytes (BLAKE2b) of the table's name and a row, with columns in the order of
    `TABLES`."""
    digest = blake2b(table.encode(), digest_size=8)
    for value in row:
        data = value if isinstance(value, bytes) else str(value).encode("utf-8", "surrogatepass")
        digest.update(struct.pack("<cQ", type(value).__name__[:1].encode(), len(data)))
        digest.update(data)
    return digest.digest()


# Maps of schema 1 are shown to the reader as schema 2. Temporary views of the connection hide the
# file's tables. Nothing is written, and saving the map writes the current schema. Sessions follow
# from the recordings' names, so two recordings of one name are one session. The node of a virtual
# node follows from recording and image name. There are no checksums, counts or landmark sums. The
# one feature type is named in the configuration.
_COMMON_VIEWS = """
CREATE TEMP TABLE kinds (kind TEXT);
INSERT INTO kinds SELECT json_extract(value, '$.features.kind') FROM main.map WHERE key = 'config' AND json_valid(value);
CREATE TEMP TABLE sessions (session_id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, json TEXT NOT NULL, checksum BLOB);
INSERT INTO sessions (session_id, name, json)
    SELECT row_number() OVER (ORDER BY first) - 1, name, '{}' FROM (
        SELECT min(place) AS first, name FROM (
            SELECT node_id AS place, recording AS name FROM main.nodes
            UNION ALL SELECT 1000000000 + image_id, recording FROM main.place_images) GROUP BY name);
CREATE TEMP VIEW edits AS SELECT 1 AS edit_id, 'build' AS name, '' AS date, 1 AS schema, NULL AS checksum;
CREATE TEMP VIEW nodes AS SELECT n.*, session_id, NULL AS checksum FROM main.nodes AS n LEFT JOIN sessions AS s ON s.name = n.recording;
CREATE TEMP VIEW place_images AS SELECT i.*, session_id, NULL AS checksum
    FROM main.place_images AS i LEFT JOIN sessions AS s ON s.name = i.recording;
"""  # noqa: E501
_VIRTUAL_NODE_VIEWS = """
CREATE TEMP TABLE pictures (recording TEXT, name TEXT, node_id INTEGER, PRIMARY KEY (recording, name));
INSERT OR REPLACE INTO pictures SELECT recording, name, node_id FROM main.nodes ORDER BY node_id;
CREATE TEMP VIEW side_nodes AS SELECT s.*, p.node_id AS of_node, NULL AS checksum
    FROM main.side_nodes AS s LEFT JOIN pictures AS p ON p.recording = s.recording AND p.name = s.name;
"""  # noqa: E501


_POINT_VIEW = """
CREATE TEMP VIEW {0}node_points AS SELECT p.*, num_points, k.kind AS kind, NULL AS checksum
    FROM main.{0}node_points AS p JOIN main.{0}nodes USING (node_id) JOIN kinds AS k;
"""
_SAME_VIEW = "CREATE TEMP VIEW {0} AS SELECT *, NULL AS checksum FROM main.{0};\n"


def schema_2_views(has_virtual_nodes: bool) -> str:
    """Return the SQL that shows a map of schema 1, with or without virtual nodes, as schema 2."""
    same = ["map", "cameras", "node_templates", "edges", "coarse_models"]
    empty, views = ["landmark_sums", "repetitions"], _COMMON_VIEWS + _POINT_VIEW.format("")
    if has_virtual_nodes:
        views += _VIRTUAL_NODE_VIEWS + _POINT_VIEW.format(VIRTUAL_PREFIX)
        same.append("side_coarse_models")
    else:
        empty += ["side_nodes", "side_node_points", "side_coarse_models"]
    for table in empty:
        columns = ", ".join(f"NULL AS {name}" for name in (*TABLES[table], "checksum"))
        views += f"CREATE TEMP VIEW {table} AS SELECT {columns} WHERE 0;\n"
    return views + "".join(map(_SAME_VIEW.format, same))


def layer_suffix(kind: str, first: str) -> str:
    """Return the end of the stored names of a feature type, given the map's first type."""
    return "" if kind == first else f"@{kind}"


def split_layer_name(stored: str) -> tuple[str, str]:
    """Return a stored name without its `layer_suffix`, and the suffix."""
    name, at, kind = stored.partition("@")
    return name, at + kind
