"""Test queries with the true nearest nodes in place of the coarse localizer's ranking."""

from __future__ import annotations

from pathlib import Path

import pytest

from built_room import built_room
from topoloc.demo.recordings import SHIPPED
from topoloc.features.feature_types import default_learned_type
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import LocalizerConfig
from topoloc.localization.map_facts.map_building import build_map
from topoloc.mapping.build import BuildConfig
from topoloc.mapping.nodes import NodeConfig
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.open import open_sequence
from topoloc_paper.known_nodes import KnownNodes, answer_with_known_nodes


@pytest.fixture(scope="module")
def lab() -> TopoMetricMap:
    """Return the map of one lap of the lab, with SURF and the learned features."""
    config = BuildConfig(nodes=NodeConfig(2.0, 2.0))
    return build_map(open_sequence(SHIPPED / "map_lap1"), config)


def test_the_nearest_node_is_ranked_first_in_every_call(tiny_recording: Path):
    topomap = built_room(tiny_recording)
    known_nodes = KnownNodes(topomap)
    for row, summary in enumerate(topomap.summaries):
        known_nodes.world_from_cam = summary.world_from_cam
        first, again = (known_nodes.rank(None, None, 3) for _ in range(2))
        assert first == again
        assert first[0].row == row
        scores = [score.score for score in first]
        assert scores == sorted(scores, reverse=True)


def test_a_query_without_a_true_pose_is_an_error(tiny_recording: Path):
    with pytest.raises(ValueError, match="world_from_cam"):
        KnownNodes(built_room(tiny_recording)).rank(None, None, 3)


def test_every_query_has_its_own_true_node_with_two_feature_types(
    lab: TopoMetricMap,
    monkeypatch: pytest.MonkeyPatch,
):
    assert lab.kinds == ["surf", default_learned_type()]
    calls = list[Rigid3 | None]()
    rank = KnownNodes.rank

    def counted(self: KnownNodes, *args: object) -> object:
        calls.append(self.world_from_cam)
        return rank(self, *args)  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(KnownNodes, "rank", counted)
    night, done = open_sequence(SHIPPED / "night"), list[tuple[str, int, int]]()
    answers = answer_with_known_nodes(
        lab,
        LocalizerConfig(),
        night,
        Rigid3.identity(),
        lambda *progress: done.append(progress),
        "night",
    )
    assert len(calls) > len(night), "some queries must need both feature types"
    assert [answer.query for answer in answers] == list(night.names)
    assert done == [("night", number, len(night)) for number in range(1, len(night) + 1)]
    nearest = [answer.result.candidates[0].node_id for answer in answers]
    assert nearest == [answer.nearest_node_id for answer in answers]
    assert sum(answer.result.localized for answer in answers) > 0.8 * len(answers)
