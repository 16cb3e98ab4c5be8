"""Test prints, screens and materials: sizes, types, readable contrast, and
reproducibility by seed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from topoloc_worlds.furnishing import interiors, printed_things, prints
from topoloc_worlds.furnishing.lettering import blank, write
from topoloc_worlds.furnishing.pictures import painting, photograph, plot
from topoloc_worlds.furnishing.screens import screen_content
from topoloc_worlds.scene import Material, Picture

MAKERS: dict[str, Callable[[np.random.Generator], Picture]] = {
    "poster": prints.poster,
    "notice": prints.notice,
    "notice board": prints.notice_board,
    "door sign": printed_things.door_sign,
    "whiteboard": prints.whiteboard,
    "carton": printed_things.carton,
    "label": printed_things.label,
    "calendar": prints.calendar,
    "screen": screen_content,
    "books": lambda rng: printed_things.book_spines(rng, [20, 31, 14]),
    "photograph": lambda rng: photograph(rng, (90, 131)),
    "painting": lambda rng: painting(rng, (80, 61)),
    "plot": lambda rng: plot(rng, (80, 121)),
}
MATERIALS: dict[str, Callable[[np.random.Generator], Material]] = {
    "plaster": interiors.plaster,
    "wood": interiors.wood,
    "laminate": interiors.laminate,
    "carpet": interiors.carpet,
    "linoleum": interiors.linoleum,
    "stone": interiors.stone_tiles,
    "ceiling": interiors.ceiling_tiles,
    "concrete": interiors.concrete,
    "brick": interiors.brick_painted,
    "sheet": interiors.painted_metal,
    "brushed": interiors.brushed_metal,
}


@pytest.mark.parametrize("name", MAKERS)
def test_a_print_is_its_seeds(name: str):
    make = MAKERS[name]
    first, again = make(np.random.default_rng(5)), make(np.random.default_rng(5))
    assert first.dtype == np.uint8
    assert first.ndim == 3
    np.testing.assert_array_equal(first, again)
    others = [make(np.random.default_rng(seed)) for seed in (6, 7)]
    assert all(
        other.shape != first.shape or np.mean(np.abs(other.astype(int) - first)) > 1.0
        for other in others
    )
    assert first.reshape(-1, 3).std(axis=0).max() > 8.0


@pytest.mark.parametrize("size", [(97, 61), (64, 200), (300, 220)])
def test_prints_take_any_size(size: tuple[int, int]):
    for make in (
        prints.poster,
        prints.notice,
        photograph,
        painting,
        plot,
        prints.whiteboard,
        prints.calendar,
    ):
        assert make(np.random.default_rng(1), size).shape == (*size, 3)


@pytest.mark.parametrize("name", MATERIALS)
def test_reflectances_are_true_to_life(name: str):
    material = MATERIALS[name](np.random.default_rng(2))
    assert not isinstance(material.color, tuple)
    linear = (material.color / 255.0) ** 2.2
    assert 0.03 < linear.mean() < 0.85
    # Structure is faint: rooms are no test charts.
    assert 0.002 < linear.mean(axis=2).std() < 0.12


def test_plaster_is_nearly_plain():
    color = interiors.plaster(np.random.default_rng(3)).color
    assert not isinstance(color, tuple)
    assert color.astype(float).std() < 8.0


def test_a_line_has_the_given_place_and_width():
    picture = blank((60, 300), (1.0, 1.0, 1.0))
    width = write(picture, "Numerical Recipes", (20, 40), 30, (0.0, 0.0, 0.0), max_width_px=120)
    rows, columns = np.nonzero(picture[:, :, 0] < 128)
    assert width <= 120
    assert 18 <= columns.min() <= 26
    assert columns.max() <= 20 + 120 + 4
    assert rows.max() < 50
