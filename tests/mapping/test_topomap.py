"""Test ids and rows: maps with removed nodes, two sessions of one name, and closed, pickled or
replaced maps."""

from __future__ import annotations

import pickle
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from built_corridor import WIDE, WalkAhead, built_corridor, seen_ahead, seen_on_the_way_back
from topoloc.errors import MapError
from topoloc.evaluation.query_localization import find_neighbour_ids
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import Localizer
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.result import Localization
from topoloc.mapping.coarse_models import node_ids_to_rows
from topoloc.mapping.nodes import NodePoses, node_distances
from topoloc.mapping.storage.entries import Edge, VirtualNodes
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import SequenceView
from topoloc_training.coarse_training import in_ids


def with_ids(topomap: TopoMetricMap, ids: list[int], kept: list[int]) -> TopoMetricMap:
    """Return the map with the node ids `ids` and only the rows `kept`. The coarse localizers still
    contain all nodes."""
    of = dict(zip([summary.node_id for summary in topomap.summaries], ids, strict=True))
    nodes = [topomap.nodes[row] for row in kept]
    nodes = [
        replace(node, summary=replace(node.summary, node_id=of[node.summary.node_id]))
        for node in nodes
    ]
    alive = {node.summary.node_id for node in nodes}
    models = {name: in_ids(model, ids) for name, model in topomap.first_layer.coarse_models.items()}
    edges = [Edge(of[edge.source_id], of[edge.target_id]) for edge in topomap.edges]
    images = [replace(image, node_id=of[image.node_id]) for image in topomap.place_images]
    sides = topomap.sides
    if sides is not None:
        side_ids = [5 + 3 * row for row in range(len(sides.nodes))]
        described = [
            replace(
                node,
                summary=replace(
                    node.summary, node_id=side_ids[row], of_node=of[node.summary.of_node or 0]
                ),
            )
            for row, node in enumerate(sides.nodes)
        ]
        described = [node for node in described if node.summary.of_node in alive]
        side_models = {name: in_ids(model, side_ids) for name, model in sides.coarse_models.items()}
        sides = VirtualNodes(
            [node.summary for node in described], described, side_models, sides.kind
        )
    return replace(
        topomap.with_first_layer(nodes=nodes, coarse_models=models, shared_errors=None),
        summaries=[node.summary for node in nodes],
        edges=[edge for edge in edges if {edge.source_id, edge.target_id} <= alive],
        place_images=[image for image in images if image.node_id in alive],
        sides=sides,
    )


@pytest.fixture(scope="module")
def renumbered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Save a map of the corridor with other ids and three middle nodes removed."""
    topomap = built_corridor()
    num, path = len(topomap.nodes), tmp_path_factory.mktemp("ids") / "corridor.topo"
    kept = [row for row in range(num) if not num // 2 - 1 <= row <= num // 2 + 1]
    with_ids(topomap, [1000 + 10 * row for row in range(num)], kept).save(path)
    return path


def test_a_map_whose_ids_are_no_rows_localizes_and_reports_ids(renumbered: Path):
    topomap, whole = TopoMetricMap.load(renumbered), Localizer(built_corridor())
    localizer = Localizer(topomap)
    ids = {summary.node_id for summary in topomap.summaries}
    assert min(ids) >= 1000
    assert topomap.rows_of(summary.node_id for summary in topomap.summaries) == topomap.rows
    with pytest.raises(KeyError):
        topomap.rows_of(np.array([0]))
    for picture, world_from_cam in seen_ahead():
        result, before = localizer.localize(picture, WIDE), whole.localize(picture, WIDE)
        assert isinstance(result, Localization)
        assert isinstance(before, Localization)
        assert np.linalg.norm(result.world_from_cam.translation - world_from_cam.translation) < 0.05
        assert {result.node_id, *(candidate.node_id for candidate in result.candidates)} <= ids
        node = topomap.summaries[topomap.row_of(result.node_id)]
        assert node.node_id == result.node_id
        if 1000 + 10 * before.node_id in ids:
            assert result.node_id == 1000 + 10 * before.node_id
            assert result.candidates[0].node_id == 1000 + 10 * before.candidates[0].node_id


def test_virtual_views_of_a_map_whose_ids_are_no_rows_are_recognised(renumbered: Path):
    topomap = TopoMetricMap.load(renumbered)
    results = [Localizer(topomap).localize(picture, WIDE) for picture, _ in seen_on_the_way_back()]
    found = [result for result in results if isinstance(result, Localization)]
    assert len(found) >= 2
    ids = {summary.node_id for summary in topomap.summaries}
    assert all(result.node_id in ids for result in found)


def test_neighbours_are_named_by_their_ids(renumbered: Path):
    topomap = TopoMetricMap.load(renumbered)
    poses = NodePoses.from_poses([summary.world_from_cam for summary in topomap.summaries])
    distances = node_distances(
        topomap.summaries[1].world_from_cam, poses, topomap.config.lambda_rot
    )
    near = find_neighbour_ids(topomap, distances)
    assert topomap.summaries[1].node_id in near
    assert near <= {summary.node_id for summary in topomap.summaries}


def test_ids_of_removed_nodes_are_not_used_again(renumbered: Path):
    topomap = TopoMetricMap.load(renumbered)
    assert topomap.next_ids.node == topomap.summaries[-1].node_id + 1
    fewer = replace(
        topomap.with_first_layer(nodes=topomap.nodes[:2]),
        summaries=topomap.summaries[:2],
        edges=[],
        place_images=[],
        sides=None,
    )
    fewer.save(renumbered.with_name("fewer.topo"))
    assert TopoMetricMap.load(renumbered.with_name("fewer.topo")).next_ids == topomap.next_ids


def test_a_model_of_removed_nodes_alone_is_a_map_error():
    model = built_corridor().first_layer.coarse_models["surf-vlad"]
    with pytest.raises(MapError, match="knows none"):
        node_ids_to_rows(model, [5000, 6000])


def test_two_recordings_of_one_name_are_two_sessions(tmp_path: Path):
    first, second = WalkAhead(0, num_pairs=4), WalkAhead(1, num_pairs=4)
    away = Rigid3(np.eye(3), np.array([50.0, 0.0, 0.0]))
    second = SequenceView(
        second, [0, 1, 2, 3], [None if pose is None else away @ pose for pose in second.poses]
    )
    topomap = build_map([first, second], poses_from=["truth", "walk.tum"])
    topomap.save(tmp_path / "two.topo")
    loaded = TopoMetricMap.load(tmp_path / "two.topo")
    assert [(session.name, session.poses_from) for session in loaded.sessions] == [
        ("walk", "truth"),
        ("walk", "walk.tum"),
    ]
    assert (
        {summary.session_id for summary in loaded.summaries}
        == {image.session_id for image in loaded.place_images}
        == {0, 1}
    )
    assert loaded.sides is not None
    for summary in loaded.sides.summaries:
        assert summary.of_node is not None
        node = loaded.summaries[loaded.row_of(summary.of_node)]
        assert (node.session_id, node.name) == (summary.session_id, summary.name)
        np.testing.assert_array_equal(
            node.world_from_cam.translation, summary.world_from_cam.translation
        )


def test_a_session_stores_its_source_and_its_light():
    (session,) = built_corridor().sessions
    assert (session.name, session.recording, session.poses_from) == ("walk", None, "given")
    assert (session.start_ns, session.end_ns, session.start_date) == (0, 1_300_000_000, None)
    assert session.camera == built_corridor().nodes[0].camera
    assert session.light is not None
    assert 0.2 < session.light.level < 0.7
    assert 0.05 < session.light.contrast < 0.4
    assert (session.light.red, session.light.blue) == (1.0, 1.0)


def test_a_closed_map_raises_an_error(renumbered: Path):
    with TopoMetricMap.load(renumbered) as topomap:
        assert len(topomap.nodes[0].features) > 0
    with pytest.raises(MapError, match=r"corridor\.topo is closed"):
        topomap.nodes[0]
    topomap.close()
    built_corridor().close()


def test_a_map_is_pickled_as_its_path_and_detects_a_replaced_file(renumbered: Path, tmp_path: Path):
    path = tmp_path / "map.topo"
    path.write_bytes(renumbered.read_bytes())
    topomap = TopoMetricMap.load(path)
    data = pickle.dumps(topomap)
    assert len(data) < 1000
    again = pickle.loads(data)
    assert [summary.node_id for summary in again.summaries] == [
        summary.node_id for summary in topomap.summaries
    ]
    changed = pickle.loads(pickle.dumps(replace(topomap, default_coarse="cnn-fc")))
    assert changed.default_coarse == "cnn-fc"
    assert len(changed.nodes[0].features) == len(topomap.nodes[0].features)
    built_corridor().save(path)
    with pytest.raises(MapError, match="replaced since"):
        pickle.loads(data)


def test_readers_keep_what_they_opened(renumbered: Path, tmp_path: Path):
    path = tmp_path / "map.topo"
    path.write_bytes(renumbered.read_bytes())
    topomap = TopoMetricMap.load(path)
    built_corridor().save(path)
    assert [node.summary.node_id for node in topomap.nodes] == [
        summary.node_id for summary in TopoMetricMap.load(renumbered).summaries
    ]
    assert len(TopoMetricMap.load(path).nodes) == len(built_corridor().nodes)


def test_threads_that_read_one_map_read_the_same(renumbered: Path):
    topomap, found = TopoMetricMap.load(renumbered), []

    def read() -> None:
        found.append(
            [node.features.descriptors.sum() for node in topomap.nodes]
            + [len(image.jpeg) for image in topomap.place_images]
        )

    threads = [threading.Thread(target=read) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 4
    assert all(of_thread == found[0] for of_thread in found)
