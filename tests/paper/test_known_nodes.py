"""The truth in the place of the coarse localizer."""

from __future__ import annotations

from pathlib import Path

from built_room import built_room, unseen_views
from tiny_world import CAMERA
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization
from topoloc_paper.known_nodes import KnownNodes


def test_a_node_is_ranked_first_where_it_stands_query_after_query(tiny_recording: Path):
    topomap = built_room(tiny_recording)
    known = KnownNodes(topomap, [summary.world_from_cam for summary in topomap.summaries])
    rankings = [known.rank(None, None, 3) for _ in topomap.summaries]
    assert [ranking[0].node_id for ranking in rankings] == list(range(len(topomap.summaries)))
    assert all(
        [score.score for score in ranking]
        == sorted((score.score for score in ranking), reverse=True)
        for ranking in rankings
    )


def test_a_localizer_takes_its_candidates_from_it(tiny_recording: Path):
    topomap = built_room(tiny_recording)
    views = unseen_views()[:3]
    localizer = Localizer(topomap, coarse=KnownNodes(topomap, [truth for _, truth in views]))
    again = KnownNodes(topomap, [truth for _, truth in views])
    for picture, _ in views:
        result = localizer.localize(picture, CAMERA)
        assert isinstance(result, Localization)
        assert [c.node_id for c in result.candidates] == [
            c.node_id for c in again.rank(None, None, localizer.config.num_candidates)
        ]
