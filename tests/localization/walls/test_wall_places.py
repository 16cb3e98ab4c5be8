"""Which places along the way both sides of a picture name."""

from __future__ import annotations

import numpy as np
import pytest

from built_corridor import WIDE, back, built_corridor
from topoloc.features.extraction import extract_features
from topoloc.features.kinds import FeatureConfig
from topoloc.features.side_views import SideViewConfig, side_views
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.walls.wall_index import WallIndex
from topoloc.localization.walls.wall_matching import SeenSide
from topoloc.localization.walls.wall_places import WallPlaces, name_places

APART = 1.0


@pytest.fixture(scope="module")
def index() -> WallIndex:
    topomap = built_corridor()
    assert topomap.sides is not None
    return WallIndex(topomap, topomap.sides)


@pytest.fixture(scope="module")
def seen() -> list[SeenSide]:
    """Both sides of a grey picture, left first: what they show does not matter here."""
    grey = np.zeros((WIDE.height, WIDE.width), np.uint8)
    views = side_views(WIDE, SideViewConfig())
    found = [view.within(extract_features(view.picture(grey), FeatureConfig())) for view in views]
    return [SeenSide(view, features, view.in_picture(features, WIDE)) for view, features in zip(views, found, strict=True)]


def _all_alike(index: WallIndex) -> list[np.ndarray]:
    return [np.ones(len(index.axes), np.float32)] * 2


def test_each_side_node_names_a_place_that_looks_back_at_its_wall(index: WallIndex, seen: list[SeenSide]):
    places = name_places(index, seen, _all_alike(index))
    assert len(places.world_from_cams) == len(index.axes)  # one view each: to the left who comes back sees what was to the right
    way_back = back(5.0).rotation[:, 2]
    assert (places.axes @ way_back > 0.9).all()
    for row, world_from_cam in enumerate(places.world_from_cams):
        side = seen[places.views[row]]
        side_from_world = side.view.from_world(world_from_cam.inverse())
        pixels = side.view.camera.img_from_cam(side_from_world.apply(index.centres))
        inside = (pixels > 0).all(axis=1) & (pixels[:, 0] < side.view.camera.width) & (pixels[:, 1] < side.view.camera.height)
        assert inside.any()


def test_a_place_that_both_views_name_comes_before_one_that_is_more_like_one_of_them(index: WallIndex, seen: list[SeenSide]):
    """Along the corridor (y): both views a little like one place, one view more like another."""
    of_view = name_places(index, seen, _all_alike(index))
    ways = of_view.centres[:, 1]
    right, twin = float(np.median(ways)), float(ways.max())
    assert twin - right > APART
    rows = {view: np.flatnonzero(of_view.views == view) for view in (0, 1)}
    places = WallPlaces(of_view.centres, of_view.axes, of_view.likeness.copy(), of_view.views, of_view.world_from_cams)
    places.likeness[:] = 0.0
    for view in (0, 1):
        places.likeness[rows[view][np.argmin(abs(ways[rows[view]] - right))]] = 0.5
    places.likeness[rows[0][np.argmax(ways[rows[0]])]] = 0.8
    first = places.likeliest(1, APART)[0]
    assert abs(first.translation[1] - right) < APART


def test_places_are_apart_and_as_many_as_are_asked_for(index: WallIndex, seen: list[SeenSide]):
    places = name_places(index, seen, _all_alike(index))
    chosen = places.likeliest(3, APART)
    assert 1 < len(chosen) <= 3
    centres = np.array([one.translation for one in chosen])
    for k in range(len(centres)):
        assert (np.linalg.norm(np.delete(centres, k, axis=0) - centres[k], axis=1) >= APART).all()
    assert places.likeliest(0, APART) == []


def test_nothing_named_is_no_place():
    nothing = WallPlaces(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.float32), np.zeros(0, int), list[Rigid3]())
    assert nothing.likeliest(8, APART) == []
