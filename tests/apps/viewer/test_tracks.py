"""Test tracks: one point for all nodes that see it, and only key points that fit it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from built_room import built_room
from topoloc.apps.export.colmap import to_colmap_model
from topoloc.apps.viewer.map_scene import MAX_ERROR_PX, create_map_scene, find_tracks
from topoloc.mapping.storage.entries import TopoNode
from topoloc.mapping.topomap import TopoMetricMap


def without_points(node: TopoNode) -> TopoNode:
    none = np.zeros(0, np.int64)
    return replace(
        node,
        features=node.features.select(none),
        points_cam=node.points_cam[none],
        point_sqrt_covs=node.point_sqrt_covs[none],
        template=b"",
        stored_descriptors=None,
    )


def test_points_of_several_nodes_become_one(tiny_recording: Path):
    topomap = built_room(tiny_recording)
    rows = list(range(len(topomap.summaries)))
    tracks = find_tracks(topomap, rows)
    num_seen = sum(len(node.points_cam) for node in topomap.nodes)
    assert len(tracks.point_rows) == len(tracks.errors_px) == num_seen
    assert len(tracks.points_world) < 0.8 * num_seen
    shown = tracks.point_rows >= 0
    assert shown.mean() > 0.8
    assert tracks.errors_px[shown].max() <= MAX_ERROR_PX * 0.5  # for images of 320 pixels
    owners = np.repeat(rows, [len(node.points_cam) for node in topomap.nodes])
    pairs = np.column_stack([tracks.point_rows, owners])[shown]
    assert len(np.unique(pairs, axis=0)) == len(pairs), "two key points of one image in one track"
    # a joined point has the position of its nodes' points
    own = np.concatenate(
        [
            node.summary.world_from_cam.apply(node.points_cam.astype(np.float64))
            for node in topomap.nodes
        ]
    )
    away = np.linalg.norm(tracks.points_world[tracks.point_rows[shown]] - own[shown], axis=1)
    assert np.median(away) < 0.01


def test_nodes_without_points_or_pictures_are_views_all_the_same(tiny_recording: Path):
    topomap = built_room(tiny_recording)
    first = without_points(topomap.nodes[0])
    for nodes in ([first, *topomap.nodes[1:]], [without_points(node) for node in topomap.nodes]):
        scene = create_map_scene(topomap.with_first_layer(nodes=nodes), "room")
        assert len(scene.views) == len(topomap.summaries)
        assert len(scene.views[0].points_img) == 0
        assert scene.views[0].image == b""
        assert set(to_colmap_model(scene)) >= {"images.txt", "points3D.txt"}


def test_pictures_of_one_name_are_told_apart(tiny_recording: Path):
    topomap = built_room(tiny_recording)
    nodes = [
        replace(node, summary=replace(node.summary, name="same.png", session_id=row))
        for row, node in enumerate(topomap.nodes)
    ]
    twice: TopoMetricMap = replace(
        topomap.with_first_layer(nodes=nodes),
        summaries=[
            replace(summary, name="same.png", session_id=row)
            for row, summary in enumerate(topomap.summaries)
        ],
    )
    scene = create_map_scene(twice, "room", with_points=False)
    assert [view.name for view in scene.views][:2] == ["session0/same.png", "session1/same.png"]
    assert [
        view.name for view in create_map_scene(twice, "room", session_id=1, with_points=False).views
    ] == ["session1/same.png"]
