"""A map that was glanced at goes on from there, and says cheaply how much could speak for a pose at
best."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from built_room import unseen_views
from tiny_world import CAMERA
from topoloc.localization import propose
from topoloc.localization.evidence import compute_log_odds
from topoloc.localization.localizer import Localizer
from topoloc.localization.query import QueryImage
from topoloc.localization.result import Localization
from topoloc.mapping.topomap import TopoMetricMap


@pytest.fixture(scope="module")
def localizer(room_map: Path) -> Iterator[Localizer]:
    with TopoMetricMap.load(room_map) as topomap:
        yield Localizer(topomap)


def test_by_all_means_after_a_glance_is_by_all_means(
    localizer: Localizer, monkeypatch: pytest.MonkeyPatch
):
    picture = QueryImage(unseen_views()[0][0], CAMERA)
    at_once, named = localizer.localize_query(picture)
    query_session, num_matched = localizer.context.query_session(picture), list[int]()
    matcher = propose.Matcher
    monkeypatch.setattr(propose, "Matcher", lambda *args: num_matched.append(1) or matcher(*args))
    glance, _ = query_session.localize_coarse_only()
    assert num_matched == [1]
    result, named_later = query_session.localize_exhaustive()
    assert num_matched == [1], "retrieval is not asked again"
    assert isinstance(glance, Localization)
    assert isinstance(at_once, Localization)
    assert isinstance(result, Localization)
    assert np.array_equal(result.world_from_cam.matrix(), at_once.world_from_cam.matrix())
    assert result.probability == at_once.probability
    assert len(named_later) == len(named)


def test_the_best_case_is_no_less_than_what_is_found(localizer: Localizer):
    for image, _ in unseen_views()[::4]:
        query_session = localizer.context.query_session(QueryImage(image, CAMERA))
        best = query_session.compute_best_case_evidence(query_session.min_rival_inliers)
        result, _ = query_session.localize_exhaustive()
        assert isinstance(result, Localization)
        assert best is not None
        assert result.evidence is not None
        assert compute_log_odds(best, localizer.context.first.weights) >= compute_log_odds(
            result.evidence, localizer.context.first.weights
        )


def test_nothing_speaks_for_another_place(localizer: Localizer):
    assert (
        localizer.context.query_session(
            QueryImage(unseen_views(seed=1)[1][0], CAMERA)
        ).compute_best_case_evidence(20.0)
        is None
    )
