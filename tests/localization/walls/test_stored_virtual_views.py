"""Virtual views that a map stores: their feature type, their file, and damage."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from built_corridor import (
    WIDE,
    WalkAhead,
    built_corridor,
    corridor_of_two_kinds,
    is_by_walls,
    is_right,
    seen_ahead,
    seen_on_the_way_back,
)
from topoloc.errors import MapError
from topoloc.features.feature_types import (
    FEATURE_TYPES,
    FeatureConfig,
    default_learned_type,
    find_feature_type,
)
from topoloc.localization.fitted_weights import load_fitted_weights
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.result import Localization, NotLocalized
from topoloc.mapping.build import BuildConfig
from topoloc.mapping.topomap import TopoMetricMap


@pytest.fixture(scope="module")
def localizer() -> Localizer:
    return Localizer(built_corridor())


def test_learned_features_use_the_virtual_views_of_the_map(tmp_path: Path):
    path = tmp_path / "corridor.topo"
    corridor_of_two_kinds().save(path)
    loaded = TopoMetricMap.load(path)
    assert loaded.sides is not None
    assert (
        loaded.sides.kind == find_feature_type(loaded.kinds[1]).virtual_view_type != loaded.kinds[1]
    )
    assert loaded.sides_for(loaded.kinds[1]) is loaded.sides
    localizer, learned = (
        Localizer(loaded),
        Localizer(loaded, LocalizerConfig(kinds=(loaded.kinds[1],))),
    )
    for picture, truth in seen_on_the_way_back()[::2]:
        assert is_right(localizer.localize(picture, WIDE), truth)
        result = learned.localize(picture, WIDE)
        assert is_by_walls(result)
        assert is_right(result, truth)
        mirrored = np.ascontiguousarray(picture[:, ::-1])
        assert isinstance(localizer.localize(mirrored, WIDE), NotLocalized)
    assert Localizer(loaded, LocalizerConfig(kinds=("surf",))).context.first.map.walls is None
    with closing(sqlite3.connect(path)) as database:
        database.execute("UPDATE map SET value = '\"sift\"' WHERE key = 'kind_of_sides'")
        database.commit()
    with pytest.raises(MapError, match="kind_of_sides"):
        TopoMetricMap.load(path)


def test_virtual_views_of_the_nodes_feature_type_are_still_used(monkeypatch: pytest.MonkeyPatch):
    network = default_learned_type()
    with monkeypatch.context() as patch:  # like maps before the network for virtual views
        patch.setitem(FEATURE_TYPES, network, replace(FEATURE_TYPES[network], sides=None))
        topomap = build_map(
            WalkAhead(0), BuildConfig(features=FeatureConfig(kind=network), other_kinds=())
        )
    assert topomap.sides is not None
    assert topomap.sides.kind == network
    localizer = Localizer(topomap)
    assert localizer.context.first.weights.walls == load_fitted_weights(network).walls
    for picture, truth in seen_on_the_way_back()[::2]:
        result = localizer.localize(picture, WIDE)
        assert is_by_walls(result)
        assert is_right(result, truth)


def test_a_map_from_a_file_gives_the_same_result(tmp_path: Path):
    path = tmp_path / "corridor.topo"
    built_corridor().save(path)
    picture, truth = seen_on_the_way_back()[1]
    assert is_right(Localizer(TopoMetricMap.load(path)).localize(picture, WIDE), truth)


SPOILT = {
    "no coarse model": "DELETE FROM side_coarse_models",
    "the model of the nodes": (
        "UPDATE side_coarse_models SET arrays = (SELECT arrays FROM coarse_models)"
    ),
}


@pytest.mark.parametrize("change", SPOILT.values(), ids=SPOILT.keys())
def test_virtual_views_that_cannot_be_ranked_are_a_map_error(tmp_path: Path, change: str):
    path = tmp_path / "corridor.topo"
    built_corridor().save(path)
    database = sqlite3.connect(path)
    database.executescript(change)
    database.close()
    localizer = Localizer(TopoMetricMap.load(path))
    assert isinstance(localizer.localize(seen_ahead()[0][0], WIDE), Localization)
    with pytest.raises(MapError, match="side_coarse_models"):
        localizer.localize(seen_on_the_way_back()[0][0], WIDE)
