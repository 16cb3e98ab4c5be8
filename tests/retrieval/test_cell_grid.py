"""Test the cells of a network with VLAD: places are recognised from beside the mapped path, also
in other light."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from topoloc.errors import MapError
from topoloc.features.extraction import extract_features
from topoloc.features.feature_types import FeatureConfig
from topoloc.features.features import Features
from topoloc.mapping.coarse_models import node_ids_to_rows
from topoloc.mapping.config import MapConfig
from topoloc.recordings.frame import to_grey
from topoloc.recordings.image_io import read_image
from topoloc.retrieval import descriptor_index
from topoloc.retrieval.coarse import VladConfig, open_coarse_localizer
from topoloc.retrieval.descriptor_index import max_shifted_products
from topoloc.retrieval.vlad import CellGrid, SurfVlad, append_positions, learn_words, vlad

NO_IMAGE = np.zeros((6, 8), np.uint8)
ROWS, COLUMNS, CHANNELS = 4, 6, 16
CONFIG = VladConfig(num_words=4, position_weight=0.0)


def places(count: int, seed: int = 0, columns: int = COLUMNS) -> np.ndarray:
    """Return the cells of `count` places, which share half of their content."""
    rng = np.random.default_rng(seed)
    common = rng.normal(size=(ROWS, columns, CHANNELS))
    return (common + rng.normal(size=(count, ROWS, columns, CHANNELS))).astype(np.float32)


def most_alike(grid: CellGrid, cells: np.ndarray, count: int) -> int:
    return int(grid.compute_similarity(cells, np.arange(count)).argmax())


def alike_by_vlad(cells: np.ndarray | None, count: int = 40) -> tuple[SurfVlad, Features]:
    """Return a map of images with equal VLAD vectors, and the features of each."""
    rows = np.random.default_rng(7).normal(size=(200, 64))
    rows = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
    zero = np.zeros(200, np.float32)
    features, words = (
        Features(np.zeros((200, 2), np.float32), zero, zero, zero, rows),
        learn_words(rows, CONFIG),
    )
    vlads = np.tile(vlad(rows, words), (count, 1))
    return SurfVlad.fit(
        words, vlads, np.arange(count), CONFIG, [None] * count if cells is None else list(cells)
    ), features


@pytest.mark.parametrize("shift", [-1, 0, 1])
def test_a_place_is_recognised_from_beside_the_path(shift: int):
    wide = places(40, columns=COLUMNS + 2)
    mapped, asked = wide[:, :, 1:-1], wide[:, :, 1 + shift : 1 + shift + COLUMNS]
    noise = 0.7 * np.random.default_rng(1).normal(size=asked.shape).astype(np.float32)
    grid = CellGrid.fit(mapped)
    assert (
        np.mean([most_alike(grid, cells, 40) == k for k, cells in enumerate(asked + noise)]) > 0.9
    )


def test_products_are_those_of_the_columns_that_both_have():
    rng = np.random.default_rng(2)
    rows, vector = (
        rng.normal(size=(5, 24)).astype(np.float32),
        rng.normal(size=24).astype(np.float32),
    )
    chosen, found = np.array([3, 0, 3]), np.empty(3, np.float32)
    max_shifted_products(rows, chosen, vector, 6, 2, found)
    for row, product in zip(rows.reshape(5, 4, 6).astype(float)[chosen], found, strict=True):
        query = vector.reshape(4, 6)
        shifted = [
            np.sum(row[max(s, 0) : 4 + min(s, 0)] * query[max(-s, 0) : 4 + min(-s, 0)])
            / (4 - abs(s))
            for s in range(-2, 3)
        ]
        assert product == pytest.approx(max(shifted), abs=1e-5)


def test_a_picture_is_wholly_like_itself():
    cells = places(20)
    found = CellGrid.fit(cells).compute_similarity(cells[3], np.arange(20))
    assert found[3] == pytest.approx(1.0, abs=0.01)
    assert found.argmax() == 3


def test_cells_distinguish_places_with_equal_vlad():
    cells = places(40)
    with_cells, features = alike_by_vlad(cells)
    asked = cells + 0.5 * places(40, seed=9)
    named = [with_cells.rank(NO_IMAGE, replace(features, cells=one), 1)[0].row for one in asked]
    assert named == list(range(40))
    assert [score.row for score in with_cells.rank(NO_IMAGE, features, 5)] == [
        0,
        1,
        2,
        3,
        4,
    ]  # without cells VLAD alone ranks
    without, _ = alike_by_vlad(None)
    assert without.rank(NO_IMAGE, replace(features, cells=cells[5]), 1)[0].row == 0
    assert not any(name.startswith("cell") for name in without.to_model().arrays)


def test_of_many_images_the_nearest_by_vlad_are_compared(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(descriptor_index, "MAX_EXACT_VECTORS", 10)
    monkeypatch.setattr(descriptor_index.DescriptorIndex.__init__, "__defaults__", (10,))
    cells = places(60)
    with_cells, features = alike_by_vlad(cells, 60)
    for k in (0, 30, 59):
        assert with_cells.rank(NO_IMAGE, replace(features, cells=cells[k]), 1)[0].row == k


def test_the_stored_model_ranks_alike():
    cells, asked = places(30), places(30, seed=5)
    localizer, features = alike_by_vlad(cells, 30)
    model = localizer.to_model()
    assert (model.arrays["cell_vectors"].dtype, model.arrays["cell_vectors"].shape) == (
        np.int8,
        (30, CHANNELS * ROWS * COLUMNS),
    )
    reopened = open_coarse_localizer(model)
    for one in asked:
        ranked = [c.rank(NO_IMAGE, replace(features, cells=one), 30) for c in (reopened, localizer)]
        assert [score.row for score in ranked[0]] == [score.row for score in ranked[1]]
        np.testing.assert_allclose(
            [score.score for score in ranked[0]], [score.score for score in ranked[1]], atol=2e-3
        )


def test_removed_nodes_are_not_ranked():
    cells = places(6)
    localizer, features = alike_by_vlad(cells, 6)
    left = open_coarse_localizer(node_ids_to_rows(localizer.to_model(), [0, 2, 5]))
    assert [
        left.rank(NO_IMAGE, replace(features, cells=cells[k]), 1)[0].row for k in (0, 2, 5)
    ] == [0, 1, 2]


@pytest.mark.parametrize(
    "cells",
    [
        places(1),
        np.tile(places(1), (4, 1, 1, 1)),
        np.zeros((3, ROWS, COLUMNS, CHANNELS), np.float32),
    ],
)
def test_one_picture_and_pictures_all_alike(cells: np.ndarray):
    found = CellGrid.fit(cells).compute_similarity(cells[0], np.arange(len(cells)))
    np.testing.assert_allclose(found, np.full(len(cells), 1.0 if cells.any() else 0.0), atol=0.01)


def test_cells_of_another_shape_are_an_error():
    localizer, features = alike_by_vlad(places(3), 3)
    with pytest.raises(MapError, match="not of the form"):
        localizer.rank(NO_IMAGE, replace(features, cells=places(1)[0, :, :5]), 1)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("cell_mean", lambda array: array[:, :3]),
        ("cell_mean", lambda array: 1e30 * array),
        ("cell_projection", lambda array: np.full_like(array, np.inf)),
        ("cell_projection", lambda array: array[:5]),
        ("cell_vectors", lambda array: array[:, 1:]),
        ("cell_vectors", lambda array: array[1:]),
        ("cell_vectors", lambda array: array.astype(np.float32)),
    ],
)
def test_a_damaged_model_is_an_error(name: str, change):
    model = alike_by_vlad(places(4), 4)[0].to_model()
    with pytest.raises(MapError, match="damaged"):
        open_coarse_localizer(
            replace(model, arrays={**model.arrays, name: change(model.arrays[name])})
        )


def test_a_real_walk_by_day_is_recognised_by_night(shared: Path):
    """Frames of equal numbers show the same place within two frames. The walk by day may be beside
    the walk by night."""
    walks = shared / "data" / "gardenspoint"
    if not walks.is_dir():
        pytest.skip(f"no walks at {walks}")
    config, night = (
        MapConfig().vlad_config_for("topoloc-net"),
        [_seen(walks / "night_right", k) for k in range(0, 100, 2)],
    )
    for walk, least in (("day_right", (0.96, 0.98)), ("day_left", (0.7, 0.94))):
        mapped = [_seen(walks / walk, k) for k in range(100)]
        found = [append_positions(features, 640, 360, config) for features in mapped]
        words = learn_words(np.concatenate(found), config)
        vlads = np.stack([vlad(descriptors, words) for descriptors in found])
        localizer = SurfVlad.fit(
            words, vlads, np.arange(100), config, [features.cells for features in mapped]
        )
        ranked = [
            [score.row for score in localizer.rank(np.empty((360, 640), np.uint8), features, 5)]
            for features in night
        ]
        apart = np.abs(np.array(ranked) - np.arange(0, 100, 2)[:, None])
        shares = np.mean(apart[:, 0] <= 2), np.mean(apart.min(axis=1) <= 2)
        assert np.all(np.array(shares) >= least), (walk, shares)


def _seen(folder: Path, k: int) -> Features:
    picture = cv2.resize(
        to_grey(read_image(folder / f"Image{k:03}.jpg")),
        (640, 360),
        interpolation=cv2.INTER_AREA,
    )
    return extract_features(picture, FeatureConfig(kind="topoloc-net"))
