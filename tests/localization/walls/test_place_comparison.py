"""Check that a place is recognised by strong matches first, and then by all matches."""

from __future__ import annotations

import numpy as np

from built_corridor import WIDE, corridor_of_two_kinds, seen_on_the_way_back
from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.localization.localizer import Localizer
from topoloc.localization.query import Deadline, QueryImage, StageClock
from topoloc.localization.walls.propose_virtual_views import Comparison
from topoloc.localization.walls.virtual_view_matching import VirtualViewSearch


def _walls(seed: int, number: int) -> VirtualViewSearch:
    localizer = Localizer(corridor_of_two_kinds())
    query_image = QueryImage(seen_on_the_way_back(seed)[number][0], WIDE)
    search = localizer.context.searches(query_image, StageClock(), Deadline())[-1]
    assert search.map.walls is not None
    return VirtualViewSearch.around(search, search.map.walls)


def test_most_strong_matches_agree_at_the_true_place_and_more_of_all():
    truth = seen_on_the_way_back()[2][1]
    walls = _walls(0, 2)
    compared = Comparison.at_place(walls, truth)
    agreed = compared.match_all()
    assert agreed is not None
    assert walls.search.weights.walls.stop.min_strong < compared.num_strong < agreed.num_agreeing
    world_from_cam = agreed.cam_from_world.inverse()
    assert translation_error(world_from_cam, truth) < 0.1
    assert np.rad2deg(rotation_error(world_from_cam, truth)) < 2.0


def test_views_of_another_corridor_agree_nowhere():
    walls = _walls(1, 2)
    compared = [Comparison.at_place(walls, place) for place in walls.places]
    assert compared
    assert max(one.num_strong for one in compared) < walls.search.weights.walls.stop.min_strong
    assert all(one.match_all() is None for one in compared)
