"""Test nodes of virtual views: wall points as cameras turned to them would measure them, and
their map tables."""

from __future__ import annotations

import json
import sqlite3
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from built_corridor import WalkAhead, built_corridor, corridor
from tiny_world import render
from topoloc.errors import MapError
from topoloc.features.extraction import FeatureConfig, make_virtual_views
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.mapping.build import BuildConfig, build_node_map
from topoloc.mapping.config import VirtualNodesConfig
from topoloc.mapping.node_drafts import (
    collect_virtual_nodes,
    create_virtual_nodes,
    select_virtual_view_nodes,
)
from topoloc.mapping.nodes import NodeConfig, NodePoses, node_distances
from topoloc.mapping.topomap import NodeSummary, TopoMetricMap, TopoNode, VirtualNodes
from topoloc.recordings.frame_preparation import PreparedFrame, prepare_frame
from topoloc.retrieval.vlad import SurfVlad


def spaced(spacing: float) -> BuildConfig:
    nodes = NodeConfig(d_thresh=0.3, lambda_rot=3.0)
    return BuildConfig(nodes=nodes, sides=VirtualNodesConfig(spacing))


@pytest.fixture(scope="module")
def sides() -> VirtualNodes:
    found = built_corridor().sides
    assert found is not None
    return found


def described(view: PreparedFrame, **limits: int) -> list[TopoNode]:
    of_node = NodeSummary(-1, "walk", "a picture", 7, Rigid3.identity(), 99)
    return create_virtual_nodes(of_node, view, FeatureConfig(), **limits)


def depth_errors(node: TopoNode) -> np.ndarray:
    """Return measured minus exact depth of the points along the virtual camera's
    axis, in metres."""
    _, depth = render(corridor(), node.summary.world_from_cam, node.camera)
    columns, rows = np.rint(node.features.points_img).astype(int).T
    return node.points_cam[:, 2] - depth[rows, columns]


def test_points_lie_at_their_pixels_in_the_virtual_view(sides: VirtualNodes):
    for node in sides.nodes:
        errors = depth_errors(node)
        assert abs(np.nanmedian(errors)) < 0.01
        assert np.nanquantile(np.abs(errors), 0.95) < 0.04
        reprojected = node.camera.img_from_cam(node.points_cam.astype(np.float64))
        np.testing.assert_allclose(reprojected, node.features.points_img, atol=1e-3)


def test_points_lie_on_the_walls_of_the_world(sides: VirtualNodes):
    for node in sides.nodes:
        points_world = node.summary.world_from_cam.apply(node.points_cam.astype(np.float64))
        to_the_right = float(node.summary.world_from_cam.rotation[0, 2])
        np.testing.assert_allclose(abs(to_the_right), 1.0, atol=0.01)
        assert np.quantile(np.abs(points_world[:, 0] - 1.1 * np.sign(to_the_right)), 0.95) < 0.04
        ahead = points_world[:, 1] - node.summary.world_from_cam.translation[1]
        assert ahead.min() > 0.9
        assert ahead.max() < 4.0


def test_covariances_cover_the_errors_and_are_turned_with_the_camera(sides: VirtualNodes):
    for node in sides.nodes:
        lower = np.zeros((len(node.points_cam), 3, 3))
        lower[:, *np.tril_indices(3)] = node.point_sqrt_covs
        covariances = lower @ lower.transpose(0, 2, 1)
        assert (np.linalg.eigvalsh(covariances)[:, 0] > 0).all()
        assert (
            np.nanquantile(np.abs(depth_errors(node)) / np.sqrt(covariances[:, 2, 2]), 0.95) < 3.0
        )
        # stereo is least exact along the ray, which is slanted in the virtual view
        rays = node.points_cam / np.linalg.norm(node.points_cam, axis=1, keepdims=True)
        worst = np.linalg.eigh(covariances)[1][:, :, 2]
        assert np.median(np.abs(np.sum(rays * worst, axis=1))) > 0.95


def test_virtual_nodes_are_numbered_and_name_their_source(sides: VirtualNodes):
    topomap = built_corridor()
    assert [node.summary.node_id for node in sides.nodes] == list(range(len(sides.nodes)))
    assert [s.node_id for s in sides.summaries] == list(range(len(sides.nodes)))
    of_names = {summary.name: summary.world_from_cam for summary in topomap.summaries}
    for node in sides.nodes:
        s = node.summary
        assert (s.recording, s.num_points) == ("walk", len(node.features))
        assert node.template_image == b""
        np.testing.assert_allclose(
            s.world_from_cam.translation, of_names[s.name].translation, atol=1e-9
        )
        from_node = of_names[s.name].rotation.T @ s.world_from_cam.rotation
        np.testing.assert_allclose(np.abs(from_node[:, 2]), [1.0, 0.0, 0.0], atol=1e-9)
    left_and_right = [
        round(float(node.summary.world_from_cam.rotation[0, 2])) for node in sides.nodes
    ]
    assert left_and_right == [-1, 1] * (len(sides.nodes) // 2)
    assert 2 < len(sides.nodes) < len(topomap.nodes)


def test_each_is_ranked_first_for_its_own_features_and_has_its_centre_on_the_wall(
    sides: VirtualNodes,
):
    (model,) = sides.coarse_models.values()
    coarse, centres = SurfVlad.from_model(model), model.arrays["centres"]
    assert centres.shape == (len(sides.nodes), 3)
    no_picture = np.zeros((1, 1), np.uint8)
    for node, centre in zip(sides.nodes, centres, strict=True):
        assert coarse.rank(no_picture, node.features, 1)[0].row == node.summary.node_id
        points_world = node.summary.world_from_cam.apply(node.points_cam.astype(np.float64))
        assert abs(abs(centre[0]) - 1.1) < 0.03
        assert points_world[:, 1].min() < centre[1] < points_world[:, 1].max()


def test_limits_on_points_are_kept():
    view = prepare_frame(WalkAhead(0)[4])
    few, all_of_them = (
        described(view, max_points=50),
        described(view, max_points=5000),
    )
    assert [len(node.features) for node in few] == [50, 50]
    for node, whole in zip(few, all_of_them, strict=True):
        assert len(whole.features) > 400
        assert (np.diff(node.features.responses) <= 0).all()  # the strongest
        np.testing.assert_array_equal(node.features.points_img, whole.features.points_img[:50])
    assert described(view, min_points=5001, max_points=5001) == []


def test_images_without_walls_have_no_virtual_views():
    view = prepare_frame(WalkAhead(0)[4])
    blank = np.full_like(view.grey, 90)
    assert described(replace(view, grey=blank, right_grey=blank)) == []
    assert make_virtual_views(view.camera, max_nearest=0.5) == ()
    assert collect_virtual_nodes([], "surf") is None


def test_without_spacing_a_map_has_none(tiny_recording: Path):
    assert select_virtual_view_nodes([Rigid3.identity()], spaced(0.0)) == set()
    config = BuildConfig(
        nodes=NodeConfig(d_thresh=0.5, lambda_rot=1.0), sides=VirtualNodesConfig(spacing=0.0)
    )
    topomap = build_node_map(replace(WalkAhead(0), num_pairs=2), config)
    assert topomap.sides is None
    assert len(topomap.nodes) > 0


@settings(max_examples=40, deadline=None)
@given(
    steps=st.lists(st.tuples(st.floats(0.0, 0.7), st.floats(-0.07, 0.07)), min_size=1, max_size=30),
    spacing=st.floats(1.0, 5.0),
)
def test_selected_nodes_are_near_each_node_and_far_from_each_other(
    steps: list[tuple[float, float]], spacing: float
):
    """The distance is Eq. 1 with a larger threshold and half the weight of rotations."""
    ways, turns = np.cumsum(np.array(steps), axis=0).T
    poses = [
        Rigid3(exp_so3(np.array([0.0, turn, 0.0])), np.array([0.0, 0.0, way]))
        for way, turn in zip(ways, turns, strict=True)
    ]
    chosen = sorted(select_virtual_view_nodes(poses, spaced(spacing)))
    assert chosen[0] == 0
    for k, pose in enumerate(poses):
        distances = node_distances(pose, NodePoses.from_poses([poses[i] for i in chosen]), 1.5)
        assert distances.min() <= spacing * 0.3 + 1e-9
        if k in chosen:
            assert np.delete(distances, chosen.index(k)).min(initial=np.inf) > spacing * 0.3


def test_a_path_mapped_in_both_directions_needs_no_virtual_views():
    there = [Rigid3(np.eye(3), np.array([0.0, 0.0, 0.3 * k])) for k in range(80)]
    back_again = [
        Rigid3(exp_so3(np.array([0.0, np.pi, 0.0])), np.array([0.5, 0.0, 0.3 * k]))
        for k in reversed(range(40))
    ]
    alone, both = (
        select_virtual_view_nodes(poses, spaced(3.0)) for poses in (there, there + back_again)
    )
    assert both < alone
    assert all(0.3 * k > 0.3 * 39 for k in both)  # only beyond the part mapped in reverse direction
    assert {k for k in alone if k > 39 + 10} == {k for k in both if k > 39 + 10}


def test_a_narrow_camera_makes_a_map_without_virtual_views():
    narrow = Camera.pinhole(320, 240, 600.0, 600.0, 159.5, 119.5)
    topomap = build_node_map(replace(WalkAhead(0), num_pairs=2, camera=narrow))
    assert topomap.sides is None


@pytest.fixture
def saved_corridor(tmp_path: Path) -> Path:
    built_corridor().save(tmp_path / "corridor.topo")
    return tmp_path / "corridor.topo"


def test_sides_come_back_from_the_file(sides: VirtualNodes, saved_corridor: Path):
    loaded = TopoMetricMap.load(saved_corridor).sides
    assert loaded is not None
    assert len(loaded.nodes) == len(loaded.summaries) == len(sides.nodes)
    for one, other, summary in zip(loaded.nodes, sides.nodes, loaded.summaries, strict=True):
        for s in (one.summary, summary):
            o = other.summary
            assert (s.node_id, s.of_node, s.name, s.t_ns, s.num_points) == (
                o.node_id,
                o.of_node,
                o.name,
                o.t_ns,
                o.num_points,
            )
            np.testing.assert_array_equal(s.world_from_cam.matrix(), o.world_from_cam.matrix())
        assert one.camera == other.camera
        for name in ("points_img", "sizes_px", "angles", "responses"):
            stored, given = (getattr(node.features, name) for node in (one, other))
            np.testing.assert_allclose(stored, given, rtol=1 / 256, atol=1 / 128)
        assert (
            np.median(np.sum(one.features.descriptors * other.features.descriptors, axis=1)) > 0.99
        )
        np.testing.assert_allclose(one.points_cam, other.points_cam, rtol=2**-16)
        np.testing.assert_allclose(one.point_sqrt_covs, other.point_sqrt_covs, rtol=1e-2, atol=1e-6)
    (one,), (other,) = loaded.coarse_models.values(), sides.coarse_models.values()
    assert (one.name, one.settings) == (other.name, json.loads(json.dumps(other.settings)))
    for name in other.arrays:
        np.testing.assert_array_equal(one.arrays[name], other.arrays[name])


def test_a_loaded_map_keeps_its_sides_when_it_is_saved_again(
    sides: VirtualNodes, saved_corridor: Path
):
    before = saved_corridor.read_bytes()
    TopoMetricMap.load(saved_corridor).save(saved_corridor)
    assert saved_corridor.read_bytes() == before
    again = TopoMetricMap.load(saved_corridor).sides
    assert again is not None
    assert [len(node.features) for node in again.nodes] == [
        len(node.features) for node in sides.nodes
    ]


QUERIES_OF_OPENING = """
import sqlite3, sys
from topoloc.mapping.storage import map_file
from topoloc.mapping.topomap import TopoMetricMap
connect, asked = sqlite3.connect, []
def traced(*args, **kwargs):
    database = connect(*args, **kwargs)
    database.set_trace_callback(asked.append)
    return database
map_file.sqlite3.connect = traced
topomap = TopoMetricMap.load(sys.argv[1])
print(asked)
topomap.sides.nodes[1]
print(asked)
"""


def test_opening_reads_no_side_node(saved_corridor: Path):
    """It runs in another process, because the shape checks of the tests read the
    entries of a map."""
    answer = subprocess.run(
        [sys.executable, "-c", QUERIES_OF_OPENING, str(saved_corridor)],
        capture_output=True,
        text=True,
        check=True,
    )
    opening, later = answer.stdout.splitlines()
    assert "FROM map" in opening
    for table in ("side_nodes", "side_node_points", "side_coarse_models"):
        assert f"FROM {table}" not in opening
        assert f"JOIN {table}" not in opening
    assert later.count("checksum FROM side_node_points WHERE") == 1


def changed(path: Path, script: str) -> Path:
    database = sqlite3.connect(path)
    database.executescript(script)
    database.close()
    return path


def read_sides(path: Path) -> None:
    topomap = TopoMetricMap.load(path)
    assert topomap.sides is not None
    (
        list(topomap.sides.summaries),
        list(topomap.sides.nodes),
        list(topomap.sides.coarse_models.values()),
    )


SPOILT = {
    "half a blob": "UPDATE side_node_points SET points_cam = substr(points_cam, 1, 100)",
    "a blob of odd length": "UPDATE side_node_points SET descriptors = descriptors || x'00'",
    "a pose of no length": "UPDATE side_nodes SET world_from_cam = x''",
    "a pose that is not finite": (
        "UPDATE side_nodes SET world_from_cam = zeroblob(88) || x'000000000000f87f'"
    ),
    "a camera that is not there": "UPDATE side_nodes SET camera_id = 1000",
    "no points": "DELETE FROM side_node_points",
    "a side node missing": "DELETE FROM side_nodes WHERE node_id = 1",
    "a coarse model cut off": "UPDATE side_coarse_models SET arrays = substr(arrays, 1, 1000)",
    "settings that are no JSON": "UPDATE side_coarse_models SET settings = '{'",
    "no table of points": "DROP TABLE side_node_points",
    "no table of coarse models": "DROP TABLE side_coarse_models",
}


@pytest.mark.parametrize("change", SPOILT.values(), ids=SPOILT.keys())
def test_damage_to_side_tables_is_a_map_error_of_one_line(saved_corridor: Path, change: str):
    changed(saved_corridor, change)
    with pytest.raises(MapError, match=r"corridor\.topo is damaged") as caught:
        read_sides(saved_corridor)
    assert "\n" not in str(caught.value)
