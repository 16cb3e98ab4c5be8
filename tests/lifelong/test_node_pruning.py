"""Check that pruning removes redundant nodes if the budget leaves few landmarks per node, and keeps
each node that no other supports."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from built_room import unseen_views
from tiny_world import CAMERA
from topoloc import Localizer, TopoMetricMap
from topoloc.apps.cli import main
from topoloc.geometry.alignment import translation_error
from topoloc.lifelong.node_pruning import (
    NodeSupport,
    compute_node_support,
    iterate_node_removals,
    remove_nodes,
)
from topoloc.localization.result import Localization
from topoloc.mapping.storage.integrity_check import find_map_damage


def _holds(landmarks: list[list[int]], pictures: list[int]) -> NodeSupport:
    """Return the support of each node by each other node."""
    num = len(landmarks)
    by = np.array([[k, *(j for j in range(num) if j != k)] for k in range(num)])
    return NodeSupport(by, np.take_along_axis(np.array(landmarks), by, axis=1), np.array(pictures))


def test_the_most_redundant_node_is_removed_first():
    holds = _holds([[500, 400, 80], [400, 500, 90], [80, 90, 500]], [1, 3, 1])
    order = list(iterate_node_removals(holds, 60))
    assert order[0][0] == 0, "its twin stands for three pictures"
    assert order[0][1].tolist() == [1, 1, 2]
    assert len(order) == 2, "one is left"


def test_nodes_without_support_stay():
    holds = _holds([[500, 50, 10], [50, 500, 10], [10, 10, 500]], [1, 1, 1])
    assert list(iterate_node_removals(holds, 60)) == []


def test_removed_nodes_still_need_support():
    """Nodes 0 and 2 support node 1. After its removal only 0 supports its place and stays, though 2
    shows enough of 0."""
    holds = _holds([[500, 300, 100], [300, 400, 30], [50, 30, 500]], [1, 1, 5])
    order = [row for row, _ in iterate_node_removals(holds, 60)]
    assert order == [1]


def test_images_edges_and_descriptors_move_to_the_supporting_node(room_map: Path, tmp_path: Path):
    path = tmp_path / "fewer.topo"
    with TopoMetricMap.load(room_map) as topomap:
        holds, num = compute_node_support(topomap, 4), len(topomap.summaries)
        assert (
            holds.landmarks[:, 0] == [summary.num_points for summary in topomap.summaries]
        ).all()
        assert holds.landmarks[:, 1].min() > 0
        rows = np.arange(num)
        remove_nodes(topomap, [2], np.where(rows == 2, 3, rows)).save(path)
        ids = [summary.node_id for summary in topomap.summaries]
    assert find_map_damage(path) == []
    with TopoMetricMap.load(path) as topomap:
        assert [summary.node_id for summary in topomap.summaries] == ids[:2] + ids[3:]
        assert ids[2] not in {image.node_id for image in topomap.place_images}
        assert all(
            {edge.source_id, edge.target_id} <= set(ids) - {ids[2]} for edge in topomap.edges
        )
        assert topomap.free_ids.node > max(ids)


def test_a_budget_below_few_landmarks_a_node_drops_nodes_and_still_localizes(
    room_map: Path, tmp_path: Path, complaint: Callable[..., str]
):
    path, said = Path(shutil.copy(room_map, tmp_path / "room.topo")), tmp_path / "said.json"
    data, budget = path.read_bytes(), 0.5 * path.stat().st_size / 1e6
    assert "landmarks each its" in complaint("prune", path, "--max-mb", f"{0.4 * budget:.4f}")
    assert main(["prune", str(path), "--max-mb", f"{budget:.4f}", "--json", str(said)]) == 0
    facts = json.loads(said.read_text())
    assert facts["nodes_dropped"] > 0
    assert facts["bytes"] == path.stat().st_size <= budget * 1e6
    assert find_map_damage(path) == []
    with TopoMetricMap.load(path) as topomap:
        localizer = Localizer(topomap)
        found = [(localizer.localize(picture, CAMERA), pose) for picture, pose in unseen_views()]
    assert (
        max(
            translation_error(pose, one.world_from_cam) if isinstance(one, Localization) else np.inf
            for one, pose in found
        )
        < 0.03
    )
    assert main(["undo", str(path)]) == 0
    assert path.read_bytes() == data


@pytest.mark.parametrize("share", [0.95, 0.8])
def test_no_node_goes_while_all_keep_enough(room_map: Path, tmp_path: Path, share: float):
    path = Path(shutil.copy(room_map, tmp_path / "room.topo"))
    with TopoMetricMap.load(path) as topomap:
        num = len(topomap.summaries)
    assert main(["prune", str(path), "--max-mb", f"{share * path.stat().st_size / 1e6:.4f}"]) == 0
    with TopoMetricMap.load(path) as topomap:
        assert len(topomap.summaries) == num
