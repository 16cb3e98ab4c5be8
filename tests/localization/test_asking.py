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
from topoloc.localization.evidence import log_odds_of
from topoloc.localization.localizer import Localizer
from topoloc.localization.query import Picture
from topoloc.localization.result import Localization
from topoloc.mapping.topomap import TopoMetricMap


@pytest.fixture(scope="module")
def localizer(room_map: Path) -> Iterator[Localizer]:
    with TopoMetricMap.load(room_map) as topomap:
        yield Localizer(topomap)


def test_by_all_means_after_a_glance_is_by_all_means(
    localizer: Localizer, monkeypatch: pytest.MonkeyPatch
):
    picture = Picture(unseen_views()[0][0], CAMERA)
    at_once, named = localizer.ask(picture)
    asking, num_matched = localizer.asking(picture), list[int]()
    matcher = propose.Matcher
    monkeypatch.setattr(propose, "Matcher", lambda *args: num_matched.append(1) or matcher(*args))
    glance, _ = asking.at_a_glance()
    assert num_matched == [1]
    result, named_later = asking.by_all_means()
    assert num_matched == [1], "retrieval is not asked again"
    assert isinstance(glance, Localization)
    assert isinstance(at_once, Localization)
    assert isinstance(result, Localization)
    assert np.array_equal(result.world_from_cam.matrix(), at_once.world_from_cam.matrix())
    assert result.probability == at_once.probability
    assert len(named_later) == len(named)


def test_the_best_case_is_no_less_than_what_is_found(localizer: Localizer):
    for image, _ in unseen_views()[::4]:
        asking = localizer.asking(Picture(image, CAMERA))
        best = asking.best_case(asking.least_inliers)
        result, _ = asking.by_all_means()
        assert isinstance(result, Localization)
        assert best is not None
        assert result.evidence is not None
        assert log_odds_of(best, localizer.weights) >= log_odds_of(
            result.evidence, localizer.weights
        )


def test_nothing_speaks_for_another_place(localizer: Localizer):
    assert localizer.asking(Picture(unseen_views(seed=1)[1][0], CAMERA)).best_case(20.0) is None
