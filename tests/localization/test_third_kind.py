"""Check that one file (`corner_patches.py`) and one fit add a feature type without
scale and angle."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from built_room import unseen_views
from corner_patches import CORNER_PATCHES
from tiny_world import CAMERA
from topoloc.errors import FeatureTypeError, MapError
from topoloc.features.feature_types import FEATURE_TYPES, FeatureConfig
from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.localization.fitted_weights import load_fitted_weights
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.result import Localization
from topoloc.mapping.build import BuildConfig
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.open import open_sequence


@pytest.fixture(scope="module")
def registered() -> Iterator[None]:
    FEATURE_TYPES[CORNER_PATCHES.name] = CORNER_PATCHES
    yield
    del FEATURE_TYPES[CORNER_PATCHES.name]


@pytest.fixture(scope="module")
def path(registered: None, tiny_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("corners") / "room.topo"
    build_map(
        open_sequence(tiny_recording), BuildConfig(features=FeatureConfig(kind=CORNER_PATCHES.name))
    ).save(path)
    return path


def test_a_map_of_it_is_built_and_queried_from_its_file(path: Path):
    localizer = Localizer(TopoMetricMap.load(path))
    results = [(localizer.localize(picture, CAMERA), truth) for picture, truth in unseen_views()]
    within = [
        isinstance(result, Localization)
        and translation_error(result.world_from_cam, truth) < 0.03
        and rotation_error(result.world_from_cam, truth) < np.deg2rad(0.6)
        for result, truth in results
    ]
    assert np.mean(within) >= 0.8
    assert not any(
        isinstance(localizer.localize(picture, CAMERA), Localization)
        for picture, _ in unseen_views(seed=3)
    )


def test_results_without_fitted_weights_are_marked(path: Path):
    topomap, (picture, _) = TopoMetricMap.load(path), unseen_views()[2]
    line = Localizer(topomap).localize(picture, CAMERA).to_json("")
    assert line["localized"] is True
    assert line["calibrated"] is False
    fitted = replace(load_fitted_weights(CORNER_PATCHES.name), calibration_error=0.02)
    assert "calibrated" not in Localizer(topomap, weights=fitted).localize(picture, CAMERA).to_json(
        ""
    )


def test_its_own_thresholds_are_used_unless_others_are_set(path: Path):
    topomap = TopoMetricMap.load(path)
    config = Localizer(topomap).context.first.config
    assert (config.guided.min_similarity, config.viewpoints.matching.min_similarity) == (0.8, 0.85)
    assert (config.matching.ratio, config.pose.sigma_px) == (
        CORNER_PATCHES.ratio,
        CORNER_PATCHES.sigma_px,
    )
    own = LocalizerConfig(matching=replace(LocalizerConfig().matching, ratio=0.7))
    config = Localizer(topomap, own).context.first.config
    assert config.matching.ratio == 0.7
    assert config.guided.max_turn == np.inf  # it has no angles to look at


def test_a_map_of_an_unknown_feature_type_is_refused_in_one_line(
    path: Path, monkeypatch: pytest.MonkeyPatch
):
    topomap = TopoMetricMap.load(path)
    monkeypatch.delitem(FEATURE_TYPES, CORNER_PATCHES.name)
    with pytest.raises(
        FeatureTypeError, match="no features of kind 'corner-patches'; there are surf, sift"
    ):
        Localizer(topomap)
    with pytest.raises(MapError) as refused:
        TopoMetricMap.load(path)
    text = str(refused.value)
    assert text.startswith(f"map {path}: no features of kind 'corner-patches'; there are surf")
    assert "topoloc.plugin.register_feature_type adds others" in text
    assert "damaged" not in text
