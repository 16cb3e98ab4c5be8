"""Maps of schema 1, shown to the reader as schema 2.

Views of the connection's own stand before the file's tables; nothing is written, and `save` makes a file of schema 2 of what they show.
Sessions follow from the names of the recordings (two of one name cannot be told apart any more), a side node's node from recording
and picture; there are no checksums, no counts and no landmark sums.
"""

from __future__ import annotations

_COMMON = """
CREATE TEMP TABLE sessions (session_id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, json TEXT NOT NULL, checksum BLOB);
INSERT INTO sessions (session_id, name, json)
    SELECT row_number() OVER (ORDER BY first) - 1, name, '{}' FROM (
        SELECT min(place) AS first, name FROM (
            SELECT node_id AS place, recording AS name FROM main.nodes
            UNION ALL SELECT 1000000000 + image_id, recording FROM main.place_images) GROUP BY name);
CREATE TEMP VIEW map AS SELECT key, value, NULL AS checksum FROM main.map;
CREATE TEMP VIEW edits AS SELECT 1 AS edit_id, 'build' AS name, '' AS date, 1 AS schema, NULL AS checksum;
CREATE TEMP VIEW cameras AS SELECT camera_id, json, NULL AS checksum FROM main.cameras;
CREATE TEMP VIEW nodes AS SELECT node_id, session_id, n.name AS name, t_ns, camera_id, world_from_cam, num_points, NULL AS checksum
    FROM main.nodes AS n LEFT JOIN sessions AS s ON s.name = n.recording;
CREATE TEMP VIEW node_templates AS SELECT node_id, jpeg, NULL AS checksum FROM main.node_templates;
CREATE TEMP VIEW edges AS SELECT source_id, target_id, NULL AS checksum FROM main.edges;
CREATE TEMP VIEW place_images AS SELECT image_id, session_id, i.name AS name, node_id, world_from_cam, jpeg, NULL AS checksum
    FROM main.place_images AS i LEFT JOIN sessions AS s ON s.name = i.recording;
CREATE TEMP VIEW landmark_sums AS SELECT 0 AS node_id, '' AS kind, 0 AS session_id, 0 AS num_rows, x'' AS sums, NULL AS checksum WHERE 0;
"""
# Of nodes and of side nodes. Every map of schema 1 has one kind of features, named in its configuration.
_POINTS = """
CREATE TEMP VIEW {0}node_points AS SELECT node_id, k.kind AS kind, num_points, descriptor_size, points_img, shapes, descriptors, points_cam,
    sqrt_covs, NULL AS checksum FROM main.{0}node_points JOIN main.{0}nodes USING (node_id) JOIN kinds AS k;
CREATE TEMP VIEW {0}coarse_models AS SELECT name, settings, arrays, NULL AS checksum FROM main.{0}coarse_models;
"""
_KINDS = """
CREATE TEMP TABLE kinds (kind TEXT);
INSERT INTO kinds SELECT json_extract(value, '$.features.kind') FROM main.map WHERE key = 'config' AND json_valid(value);
"""
_SIDES = """
CREATE TEMP TABLE pictures (recording TEXT, name TEXT, node_id INTEGER, PRIMARY KEY (recording, name));
INSERT OR REPLACE INTO pictures SELECT recording, name, node_id FROM main.nodes ORDER BY node_id;
CREATE TEMP VIEW side_nodes AS SELECT s.node_id AS node_id, p.node_id AS of_node, s.name AS name, t_ns, camera_id, world_from_cam,
    num_points, NULL AS checksum FROM main.side_nodes AS s LEFT JOIN pictures AS p ON p.recording = s.recording AND p.name = s.name;
"""
_NO_SIDES = """
CREATE TEMP VIEW side_nodes AS SELECT 0 AS node_id, 0 AS of_node, '' AS name, 0 AS t_ns, 0 AS camera_id, x'' AS world_from_cam,
    0 AS num_points, NULL AS checksum WHERE 0;
"""

SHOW_AS_SCHEMA_2 = {
    False: _KINDS + _COMMON + _POINTS.format("") + _NO_SIDES,
    True: _KINDS + _COMMON + _POINTS.format("") + _SIDES + _POINTS.format("side_"),
}
