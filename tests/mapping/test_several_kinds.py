"""Test a map of several feature types: its content is read back, and each type can
be used alone."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from built_room import room_of_two_kinds, unseen_views
from tiny_world import CAMERA
from topoloc.errors import FeatureTypeError, WeightsError
from topoloc.features.feature_types import default_learned_type
from topoloc.geometry.alignment import translation_error
from topoloc.localization.feature_map import FeatureMap
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.query import QueryImage
from topoloc.localization.result import Localization
from topoloc.mapping.build import BuildConfig
from topoloc.mapping.config import MapConfig
from topoloc.mapping.storage.integrity_check import find_map_damage
from topoloc.mapping.storage.map_reading import list_coarse_models
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.open import open_sequence
from topoloc.retrieval.vlad import CellGrid


@pytest.fixture(scope="module")
def of_two(tiny_recording: Path) -> TopoMetricMap:
    return room_of_two_kinds(tiny_recording)


@pytest.fixture
def path(of_two: TopoMetricMap, tmp_path: Path) -> Path:
    of_two.save(tmp_path / "room.topo")
    return tmp_path / "room.topo"


def test_both_feature_types_are_read_back_and_saved_byte_identically(
    of_two: TopoMetricMap, path: Path, tmp_path: Path
):
    loaded = TopoMetricMap.load(path)
    assert loaded.kinds == of_two.kinds == ["surf", "sift"]
    assert loaded.config == of_two.config
    assert loaded.config.other_kinds == ("sift",)
    stored = [model["name"] for model in list_coarse_models(path)]
    assert stored == ["surf-vlad", "surf-vlad@sift"]
    for kind in loaded.kinds:
        one, other = loaded.layers[kind], of_two.layers[kind]
        assert list(one.coarse_models) == list(other.coarse_models) == ["surf-vlad"]
        assert one.shared_errors == other.shared_errors is not None
        for node, was in zip(one.nodes, other.nodes, strict=True):
            assert node.features.descriptors.shape == was.features.descriptors.shape
            points_img = node.features.points_img, was.features.points_img
            np.testing.assert_allclose(*points_img, rtol=0.0, atol=1 / 128)
            np.testing.assert_allclose(node.points_cam, was.points_cam, rtol=2**-16)
            assert node.summary.num_points == was.summary.num_points == len(node.features)
    loaded.save(tmp_path / "again.topo")
    assert (tmp_path / "again.topo").read_bytes() == path.read_bytes()
    assert find_map_damage(path) == []


def test_the_first_feature_type_equals_a_map_of_it_alone(
    of_two: TopoMetricMap, tiny_map: TopoMetricMap
):
    assert len(of_two.nodes) == len(tiny_map.nodes)
    for one, other in zip(of_two.nodes, tiny_map.nodes, strict=True):
        np.testing.assert_array_equal(one.points_cam, other.points_cam)
        np.testing.assert_array_equal(one.features.descriptors, other.features.descriptors)


def test_a_damaged_point_of_the_second_type_is_found(path: Path):
    content = path.read_bytes()
    with closing(sqlite3.connect(path)) as database:
        (packed,) = database.execute(
            "SELECT points_cam FROM node_points WHERE kind = 'sift' ORDER BY node_id LIMIT 1"
        ).fetchone()
    place = content.index(packed[:40]) + 20
    path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
    assert any("node_points" in damage for damage in find_map_damage(path))


def test_it_localizes_with_the_second_type_alone(path: Path):
    loaded = TopoMetricMap.load(path)
    assert loaded.sides_for("sift") is None
    localizer = Localizer(loaded, LocalizerConfig(kinds=("sift",)))
    results = [(localizer.localize(picture, CAMERA), truth) for picture, truth in unseen_views()]
    assert all(
        isinstance(result, Localization) and translation_error(result.world_from_cam, truth) < 0.03
        for result, truth in results
    )


def test_a_feature_type_outside_of_the_map_is_refused(of_two: TopoMetricMap):
    with pytest.raises(FeatureTypeError, match=r"no features xfeat \(it holds: surf, sift\)"):
        FeatureMap(of_two, kind="xfeat")


def test_a_query_that_one_type_settles_extracts_no_other(of_two: TopoMetricMap):
    ((picture, truth), *_) = unseen_views()
    query = QueryImage(picture, CAMERA)
    result, _ = Localizer(of_two).localize_query(query)
    assert isinstance(result, Localization)
    assert translation_error(result.world_from_cam, truth) < 0.01
    assert {config.kind for _, _, config, _ in query.features._kept} == {"surf"}


def test_the_cells_of_a_network_are_learned_stored_and_used(
    tiny_recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    build_map(
        open_sequence(f"{tiny_recording}@0::2"), BuildConfig(other_kinds=("topoloc-net",))
    ).save(tmp_path / "room.topo")
    loaded = TopoMetricMap.load(tmp_path / "room.topo")
    assert "cell_vectors" not in loaded.first_layer.coarse_models["surf-vlad"].arrays
    model = loaded.layers["topoloc-net"].coarse_models["surf-vlad"]
    assert len(model.arrays["cell_vectors"]) == len(loaded.place_images)
    assert find_map_damage(tmp_path / "room.topo") == []
    compute_similarity, asked = CellGrid.compute_similarity, list[tuple[int, ...]]()
    monkeypatch.setattr(
        CellGrid,
        "compute_similarity",
        lambda self, cells, images: (
            asked.append(cells.shape) or compute_similarity(self, cells, images)
        ),
    )
    for kind, expected in (("surf", []), ("topoloc-net", [(4, 6, 64)])):
        ((picture, truth), *_) = unseen_views()
        result = Localizer(loaded, LocalizerConfig(kinds=(kind,))).localize(picture, CAMERA)
        assert isinstance(result, Localization)
        assert translation_error(result.world_from_cam, truth) < 0.05
        assert asked == expected


def test_missing_feature_types_are_an_error_before_the_work(tiny_recording: Path):
    for kinds, said in ((("orb",), FeatureTypeError), (("edgepoint2-s64",), WeightsError)):
        done: list[str] = []
        with pytest.raises(said):
            build_map(
                open_sequence(tiny_recording),
                BuildConfig(other_kinds=kinds),
                lambda stage, k, n, done=done: done.append(stage),
            )
        assert not done


def test_learned_types_are_added_to_surf_unless_others_are_named():
    assert MapConfig().kinds == ["surf", default_learned_type()]
    assert MapConfig(other_kinds=("sift",)).kinds == ["surf", "sift"]
    sift = MapConfig(other_kinds=("sift",)).feature_config_for("sift")
    assert (sift.kind, sift.max_features) == ("sift", MapConfig().features.max_features)
