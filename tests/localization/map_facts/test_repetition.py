"""Test repetitions: the transforms that the map finds, and the results at repeated places."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from built_room import built_room, unseen_views
from doubled_room import ELSEWHERE, twice
from tiny_world import CAMERA
from topoloc.features.features import Features
from topoloc.geometry.alignment import translation_error
from topoloc.geometry.rigid import Rigid3
from topoloc.localization import feature_map
from topoloc.localization.config import LocalizerConfig
from topoloc.localization.feature_map import FeatureMap
from topoloc.localization.localizer import Localizer
from topoloc.localization.map_facts.map_building import with_repetitions
from topoloc.localization.map_facts.repetition import (
    find_repetition_shifts,
    fold_repetitions,
)
from topoloc.localization.pose_fit import LocalMap
from topoloc.localization.result import Localization, NotLocalized
from topoloc.mapping.storage.integrity_check import find_map_damage
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.retrieval.coarse import Image, NodeScore

PERIOD = np.array([0.8, 0.0, 0.0])
PANEL = np.random.default_rng(3).uniform([0.0, -1.0, 2.0], [0.8, 1.0, 2.0], (40, 3))


@pytest.fixture(scope="module")
def room(tiny_recording: Path) -> TopoMetricMap:
    return built_room(tiny_recording)


def _wall(num_panels: int, noise: float = 0.0) -> LocalMap:
    """Return a wall of equal panels. Each panel has its own noise in the descriptors."""
    rng = np.random.default_rng(5)
    looks = rng.normal(size=(len(PANEL), 64))
    descriptors = np.concatenate(
        [looks + noise * rng.normal(size=looks.shape) for _ in range(num_panels)]
    )
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    points_world = np.concatenate([PANEL + k * PERIOD for k in range(num_panels)])
    count, one = len(points_world), np.full(len(points_world), 0.02)
    return LocalMap(
        descriptors.astype(np.float32),
        points_world,
        np.zeros((count, 3, 3)),
        one,
        np.zeros(count, int),
        one,
        np.zeros((count, 3)),
    )


# shifts to nearby copies


@pytest.mark.parametrize("noise", [0.0, 0.2])
def test_a_wall_of_equal_panels_repeats_itself_by_whole_panels(noise: float):
    wall = _wall(4, noise)
    shifts = find_repetition_shifts(wall, wall)
    along = shifts[:, 0] / PERIOD[0]
    np.testing.assert_allclose(shifts[:, 1:], 0.0, atol=0.01)
    np.testing.assert_allclose(along, np.round(along), atol=0.02)
    assert {-1, 1} <= set(np.round(along).astype(int))


def test_unique_surfaces_have_no_repetition():
    assert len(find_repetition_shifts(_wall(1), _wall(1))) == 0


def test_similar_parts_within_a_panel_are_no_repetition():
    """With one handle above another, a third of the points have a copy there. All points have one
    in the next panel."""
    wall = _wall(4)
    few = np.tile(np.arange(len(PANEL)) < 13, 4)
    above = LocalMap(
        wall.descriptors[few], wall.points_world[few] + [0.0, 0.0, 0.5], wall.covariances[few], wall.radii[few],  # noqa: E501
        wall.node_ids[few], wall.sizes[few], wall.directions[few],
    )  # fmt: skip
    np.testing.assert_allclose(
        find_repetition_shifts(wall, LocalMap.concatenate([wall, above]))[:, 2], 0.0, atol=0.01
    )


def test_folded_points_of_all_panels_are_the_points_of_one():
    points_world = fold_repetitions(_wall(4).points_world, np.array([PERIOD, -PERIOD, 2 * PERIOD]))
    spread = points_world.reshape(4, len(PANEL), 3) - points_world[: len(PANEL)]
    np.testing.assert_allclose(spread, 0.0, atol=1e-9)


# moves across the whole map


def _turned(opened: FeatureMap, row: int) -> list[Rigid3]:
    """Return the transforms with a rotation. All surfaces of this room are blobs,
    which look similar."""
    return [move for move in map(Rigid3.from_matrix, opened.moves(row)) if move.angle() > 0.1]


def test_a_room_that_stands_twice_in_the_map_is_moved_onto_its_copy_and_back(room: TopoMetricMap):
    opened, num_nodes = FeatureMap(twice(room)), len(room.nodes)
    num_found = 0
    for row in range(2 * num_nodes):
        expected = ELSEWHERE if row < num_nodes else ELSEWHERE.inverse()
        pose, moves = opened.topomap.summaries[row].world_from_cam, _turned(opened, row)
        assert all(translation_error(move @ pose, expected @ pose) < 0.05 for move in moves)
        num_found += len(moves) > 0
    assert num_found >= 0.9 * 2 * num_nodes


def test_a_room_that_stands_once_in_the_map_has_no_copy(room: TopoMetricMap):
    opened = FeatureMap(room)
    assert not any(_turned(opened, row) for row in range(len(room.nodes)))


def test_repetitions_of_the_build_are_stored_and_not_searched_again(
    room: TopoMetricMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    built = with_repetitions(twice(room))
    built.save(tmp_path / "twice.topo")
    sought = []
    monkeypatch.setattr(feature_map, "find_repetition_shifts", lambda *given: sought.append(given))
    with TopoMetricMap.load(tmp_path / "twice.topo") as topomap:
        opened = FeatureMap(topomap)
        for row, node_id in enumerate(opened.node_ids):
            assert built.repetitions is not None
            np.testing.assert_array_equal(
                opened.moves(row), built.repetitions.moves.get(node_id, np.zeros((0, 4, 4)))
            )
        assert find_map_damage(tmp_path / "twice.topo") == []
    assert sought == []


def test_repetitions_of_changed_nodes_are_searched_again(room: TopoMetricMap):
    assert room.repetitions is not None
    doubled = twice(room)
    assert doubled.repetitions is room.repetitions
    assert any(_turned(FeatureMap(doubled), row) for row in range(len(doubled.nodes)))


class _OnlyTheFirstRoom:
    """Rank only nodes of the first room."""

    def __init__(self, num_nodes: int) -> None:
        self._num_nodes = num_nodes

    def rank(self, image: Image, features: Features, num_candidates: int) -> list[NodeScore]:
        return [
            NodeScore(row, 1.0 / (1 + row)) for row in range(min(num_candidates, self._num_nodes))
        ]


@pytest.mark.parametrize("max_repetitions", [LocalizerConfig().max_repetitions, 0])
def test_a_copy_missed_by_retrieval_is_found_by_the_map(
    room: TopoMetricMap, max_repetitions: int, monkeypatch: pytest.MonkeyPatch
):
    """Without repetitions, one of the two places is reported, and half of these poses are wrong."""
    monkeypatch.setattr(LocalizerConfig, "max_repetitions", max_repetitions)
    localizer = Localizer(
        twice(room),
        coarse=_OnlyTheFirstRoom(len(room.nodes)),
    )
    results = [(localizer.localize(picture, CAMERA), truth) for picture, truth in unseen_views()]
    ambiguous = [
        (result, truth)
        for result, truth in results
        if isinstance(result, NotLocalized) and result.reason == "ambiguous"
    ]
    if max_repetitions == 0:
        assert any(isinstance(result, Localization) for result, _ in results)
        return
    assert len(ambiguous) >= 0.8 * len(results)
    assert not any(isinstance(result, Localization) for result, _ in results)
    for result, truth in ambiguous:
        assert (
            min(
                translation_error(one.world_from_cam, ELSEWHERE @ truth)
                for one in result.alternatives
            )
            < 0.05
        )
