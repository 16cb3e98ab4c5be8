"""Test the places that both virtual views of an image retrieve."""

from __future__ import annotations

import numpy as np
import pytest

from built_corridor import WIDE, back, built_corridor
from topoloc.features.extraction import VirtualView, make_virtual_views
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.walls.virtual_view_index import (
    CandidatePlaces,
    VirtualViewIndex,
    select_likeliest_places,
)

APART = 1.0


@pytest.fixture(scope="module")
def index() -> VirtualViewIndex:
    topomap = built_corridor()
    assert topomap.sides is not None
    return VirtualViewIndex(topomap, topomap.sides)


@pytest.fixture(scope="module")
def views() -> list[VirtualView]:
    return list(make_virtual_views(WIDE))


def _named(index: VirtualViewIndex, views: list[VirtualView]) -> list[CandidatePlaces]:
    return [
        CandidatePlaces.from_similarity(view, index, np.ones(len(index.axes), np.float32))
        for view in views
    ]


def test_each_virtual_view_gives_a_place_that_faces_its_wall_in_reverse(
    index: VirtualViewIndex, views: list[VirtualView]
):
    named = _named(index, views)
    assert sum(len(of_view.likeness) for of_view in named) == len(
        index.axes
    )  # left and right are exchanged in reverse direction
    for view, of_view in zip(views, named, strict=True):
        assert (of_view.rotations[:, :, 2] @ back(5.0).rotation[:, 2] > 0.9).all()
        for rotation, centre in zip(of_view.rotations, of_view.centres, strict=True):
            side_from_world = view.virtual_from_world(Rigid3(rotation, centre).inverse())
            pixels = view.camera.img_from_cam(side_from_world.apply(index.centres))
            assert (
                (pixels > 0).all(axis=1)
                & (pixels[:, 0] < view.camera.width)
                & (pixels[:, 1] < view.camera.height)
            ).any()


def test_a_place_of_both_views_ranks_before_a_better_place_of_one(
    index: VirtualViewIndex, views: list[VirtualView]
):
    """Along the corridor (y), both views are similar to one place, and one view is more
    similar to another."""
    named = _named(index, views)
    ways = [of_view.centres[:, 1] for of_view in named]
    right, twin = float(np.median(ways[0])), float(ways[0].max())
    assert twin - right > APART
    for of_view, of_way in zip(named, ways, strict=True):
        of_view.likeness[:] = 0.0
        of_view.likeness[np.argmin(abs(of_way - right))] = 0.5
    named[0].likeness[np.argmax(ways[0])] = 0.8
    assert abs(select_likeliest_places(named, 1, APART)[0].translation[1] - right) < APART
    assert abs(select_likeliest_places(named[:1], 1, APART)[0].translation[1] - twin) < APART


def test_places_are_apart_and_as_many_as_requested(
    index: VirtualViewIndex, views: list[VirtualView]
):
    chosen = select_likeliest_places(_named(index, views), 3, APART)
    assert 1 < len(chosen) <= 3
    centres = np.array([one.translation for one in chosen])
    for k in range(len(centres)):
        assert (np.linalg.norm(np.delete(centres, k, axis=0) - centres[k], axis=1) >= APART).all()
    assert select_likeliest_places(_named(index, views), 0, APART) == []


def test_no_retrieved_view_gives_no_place():
    nothing = CandidatePlaces(np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0, np.float32))
    assert select_likeliest_places([nothing, nothing], 8, APART) == []
    assert select_likeliest_places([], 8, APART) == []
