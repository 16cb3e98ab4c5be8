"""Test `topoloc prune`: landmarks that later sessions missed are removed, a size limit is met, and
the map still localizes."""

from __future__ import annotations

import json
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from built_room import unseen_views
from tiny_world import CAMERA
from topoloc import Localizer, TopoMetricMap
from topoloc.apps.cli import main
from topoloc.errors import MapError
from topoloc.geometry.alignment import translation_error
from topoloc.lifelong.node_pruning import select_landmarks
from topoloc.lifelong.prune import _FileSize
from topoloc.localization.result import Localization
from topoloc.mapping.edit import edit_map
from topoloc.mapping.landmark_statistics import LandmarkStatistics
from topoloc.mapping.storage.integrity_check import find_map_damage


def _counts(num_points: int, expected: int, seen: np.ndarray) -> LandmarkStatistics:
    rows = np.arange(num_points)
    return LandmarkStatistics.from_equations(
        1,
        rows,
        np.zeros((num_points, 3, 3)),
        np.zeros((num_points, 3)),
        np.full(num_points, expected),
        seen,
    )


def _with_later_session(
    path: Path, seen_of: Callable[[int], np.ndarray], expected: int = 6
) -> None:
    """Add the statistics of a second session that observed each node."""
    with edit_map(path) as edit:
        topomap = edit.topomap
        nodes = []
        for node in topomap.nodes:
            num = len(node.features)
            nodes.append(
                replace(
                    node,
                    session_statistics=[
                        *node.session_statistics,
                        _counts(num, expected, seen_of(num)),
                    ],
                )
            )
        sessions = [*topomap.sessions, replace(topomap.sessions[0], session_id=1, name="later")]
        edit.commit(replace(topomap.with_first_layer(nodes=nodes), sessions=sessions), "later")


def _num_points(path: Path) -> list[int]:
    with TopoMetricMap.load(path) as topomap:
        return [summary.num_points for summary in topomap.summaries]


def _errors_m(path: Path) -> list[float]:
    with TopoMetricMap.load(path) as topomap:
        localizer = Localizer(topomap)
        found = [(localizer.localize(picture, CAMERA), pose) for picture, pose in unseen_views()]
    return [
        translation_error(pose, one.world_from_cam) if isinstance(one, Localization) else np.inf
        for one, pose in found
    ]


def test_only_missing_landmarks_are_removed(room_map: Path, tmp_path: Path):
    path = Path(shutil.copy(room_map, tmp_path / "room.topo"))
    _with_later_session(path, lambda num: np.where(np.arange(num) % 4 == 0, 0, 5))
    before, data = _num_points(path), path.read_bytes()
    with TopoMetricMap.load(path) as topomap:
        kept = topomap.nodes[2].features.points_img[np.arange(before[2]) % 4 != 0]
    assert main(["prune", str(path)]) == 0
    assert _num_points(path) == [num - -(-num // 4) for num in before]
    with TopoMetricMap.load(path) as topomap:
        np.testing.assert_array_equal(topomap.nodes[2].features.points_img, kept)
        assert [
            session_statistics.session_id
            for session_statistics in topomap.nodes[2].session_statistics
        ] == [0, 1]
    assert find_map_damage(path) == []
    assert max(_errors_m(path)) < 0.02
    assert main(["prune", str(path)]) == 0
    assert main(["undo", str(path)]) == 0
    assert path.read_bytes() == data


def test_landmarks_hidden_by_other_light_stay(room_map: Path, tmp_path: Path):
    """A session that matches a tenth of a node's landmarks is no evidence about the others."""
    path = Path(shutil.copy(room_map, tmp_path / "room.topo"))
    _with_later_session(path, lambda num: np.where(np.arange(num) % 10 == 0, 6, 0))
    before = path.read_bytes()
    assert main(["prune", str(path)]) == 0
    assert path.read_bytes() == before


def test_landmarks_missed_by_chance_stay(room_map: Path, tmp_path: Path):
    """A session that finds a third of the visible landmarks misses one in six images with
    probability 1/11."""
    path = Path(shutil.copy(room_map, tmp_path / "room.topo"))
    _with_later_session(path, lambda num: np.where(np.arange(num) % 3 == 0, 6, 0))
    before = path.read_bytes()
    assert main(["prune", str(path)]) == 0
    assert path.read_bytes() == before


@pytest.mark.parametrize("share", [0.95, 0.7, 0.6])
def test_a_size_is_kept(room_map: Path, tmp_path: Path, share: float):
    path = Path(shutil.copy(room_map, tmp_path / "room.topo"))
    budget = share * path.stat().st_size
    assert main(["prune", str(path), "--max-mb", f"{budget / 1e6:.6f}"]) == 0
    assert 0.9 * budget < path.stat().st_size <= budget


def test_a_size_is_kept_and_the_map_still_localizes(room_map: Path, tmp_path: Path):
    path, said = Path(shutil.copy(room_map, tmp_path / "room.topo")), tmp_path / "said.json"
    size = path.stat().st_size
    assert (
        main(["prune", str(path), "--max-mb", f"{0.75 * size / 1e6:.4f}", "--json", str(said)]) == 0
    )
    assert path.stat().st_size <= 0.75 * size
    facts = json.loads(said.read_text())
    assert facts["bytes"] == path.stat().st_size
    assert facts["landmarks_dropped"] > 0
    assert find_map_damage(path) == []
    assert max(_errors_m(path)) < 0.02


def test_remaining_landmarks_are_spread_over_the_image(room_map: Path, tmp_path: Path):
    path = Path(shutil.copy(room_map, tmp_path / "room.topo"))
    with TopoMetricMap.load(path) as topomap:
        before = topomap.nodes[3].features.points_img
    assert main(["prune", str(path), "--max-mb", f"{0.75 * path.stat().st_size / 1e6:.4f}"]) == 0
    with TopoMetricMap.load(path) as topomap:
        after = topomap.nodes[3].features.points_img
    assert len(after) < 0.9 * len(before)
    cells_before, cells_after = (
        {tuple(cell) for cell in (points // 40).astype(int)} for points in (before, after)
    )
    assert len(cells_after) == len(cells_before), "no cell is emptied while others hold many"


def test_a_budget_that_is_too_small_changes_nothing(
    room_map: Path, tmp_path: Path, complaint: Callable[..., str]
):
    path = Path(shutil.copy(room_map, tmp_path / "room.topo"))
    assert "with 100 landmarks each its" in complaint("prune", path, "--max-mb", 0.01)
    assert "--max-mb" in complaint("prune", path, "--max-mb", -1, status=2)
    assert "nan" in complaint("prune", path, "--max-mb", "nan", status=2)


def test_the_size_of_a_map_is_measured_behind_the_checks_of_its_file(
    room_map: Path, tmp_path: Path, complaint: Callable[..., str]
):
    path = Path(shutil.copy(room_map, tmp_path / "forged.topo"))
    with closing(sqlite3.connect(path)) as database:
        database.execute("CREATE VIEW more AS SELECT * FROM node_points")
        database.commit()
    with pytest.raises(MapError, match=r"forged\.topo is damaged"):
        _FileSize.measure(path, ["surf"])
    for words in (("prune", path), ("merge", room_map, path, tmp_path / "out.topo")):
        assert "forged.topo is damaged" in complaint(*words)


def test_removed_points_lose_their_session_statistics(room_map: Path):
    with TopoMetricMap.load(room_map) as topomap:
        node = topomap.nodes[0]
        kept = np.arange(1, len(node.features), 3)
        fewer = select_landmarks(node, kept)
        assert fewer.summary.num_points == len(fewer.features) == len(fewer.points_cam) == len(kept)
        for before, after in zip(node.session_statistics, fewer.session_statistics, strict=True):
            of = {
                int(row): int(count)
                for row, count in zip(before.rows, before.expected, strict=True)
            }
            assert [of[int(kept[row])] for row in after.rows] == after.expected.tolist()
