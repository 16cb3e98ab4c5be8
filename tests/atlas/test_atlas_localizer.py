"""Check that an atlas returns the result of the right tile, names it, and reports similar
tiles as ambiguous."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from built_room import unseen_views
from tiny_world import CAMERA
from topoloc.atlas.atlas import Atlas
from topoloc.atlas.config import AtlasConfig
from topoloc.atlas.editing import add_tiles, new_tiles
from topoloc.atlas.map_cache import MapCache
from topoloc.errors import AtlasError
from topoloc.geometry.geodesy import GeoPoint, Georeference
from topoloc.geometry.rigid import Rigid3
from topoloc.localization import query
from topoloc.localization.localizer import Localizer
from topoloc.localization.map_query import MapQuery
from topoloc.localization.result import Localization, NotLocalized, result_from_json
from topoloc.mapping.topomap import TopoMetricMap

BUDGET = 100_000_000


class Wide(AtlasConfig):
    """Search tiles although others are far more similar, each coarse only first."""

    min_ranking_margin = 2.0
    max_similarity_gap = 2.0


def _localizer(
    where: Path,
    config: AtlasConfig | None = None,
    warn: list[str] | None = None,
    budget: int = BUDGET,
) -> Localizer:
    return Localizer(
        Atlas.open(str(where)),
        tiles=config,
        maps=MapCache([], Localizer, budget),
        warn=(warn if warn is not None else []).append,
    )


@pytest.fixture(scope="module")
def asked(atlas: Path) -> Localizer:
    return _localizer(atlas)


def test_the_right_tile_answers_as_it_does_alone(asked: Localizer, room_map: Path):
    with TopoMetricMap.load(room_map) as topomap:
        alone = Localizer(topomap)
        for image, world_from_cam in unseen_views()[::3]:
            result, by_map = asked.localize(image, CAMERA), alone.localize(image, CAMERA)
            assert isinstance(result, Localization)
            assert isinstance(by_map, Localization)
            assert result.provenance.tile == "room"
            assert result.provenance.map_id == by_map.provenance.map_id
            assert np.array_equal(result.world_from_cam.matrix(), by_map.world_from_cam.matrix())
            assert (
                np.linalg.norm(result.world_from_cam.translation - world_from_cam.translation) < 0.1
            )


def test_the_other_room_is_the_other_tile(asked: Localizer):
    image, _ = unseen_views(seed=1)[1]
    result = asked.localize(image, CAMERA)
    assert isinstance(result, Localization)
    assert result.provenance.tile == "other"


def test_a_third_room_is_none(asked: Localizer):
    for image, _ in unseen_views(seed=2)[:3]:
        result = asked.localize(image, CAMERA)
        assert isinstance(result, NotLocalized)
        assert result.provenance.tile in ("room", "other")


def test_a_result_names_its_tile_in_json(asked: Localizer):
    result = asked.localize(unseen_views()[0][0], CAMERA, t_ns=7)
    line = result.to_json("view")
    assert (line["tile"], line["t_ns"]) == ("room", 7)
    assert "atlas_from_cam" not in line
    assert result_from_json(line).provenance == result.provenance


def test_features_are_extracted_once_for_all_tiles(atlas: Path, monkeypatch: pytest.MonkeyPatch):
    kinds = list[str]()
    extract = query.extract_from_normalized

    def counted(normalized: np.ndarray, config: query.FeatureConfig) -> query.Features:
        kinds.append(config.kind)
        return extract(normalized, config)

    monkeypatch.setattr(query, "extract_from_normalized", counted)
    _localizer(atlas, Wide()).localize(unseen_views(seed=2)[0][0], CAMERA)
    assert kinds == ["surf"]


@pytest.mark.parametrize(("min_similarity", "num_asked"), [(-1.0, 2), (2.0, 1)])
def test_without_a_similar_tile_only_the_likeliest_is_searched_exhaustively(
    atlas: Path, monkeypatch: pytest.MonkeyPatch, min_similarity: float, num_asked: int
):
    asked = list[str]()
    exhaustive = MapQuery.search_all
    monkeypatch.setattr(
        MapQuery,
        "search_all",
        lambda self: asked.append(self.opened.map_id) or exhaustive(self),
    )
    monkeypatch.setattr(Wide, "min_similarity", min_similarity)
    config = Wide()
    result = _localizer(atlas, config).localize(unseen_views(seed=2)[0][0], CAMERA)
    assert isinstance(result, NotLocalized)
    assert len(asked) == num_asked


def test_two_equally_likely_tiles_are_both_named(own_atlas: Path, room_map: Path):
    """Two buildings have the same room, and no image can distinguish them."""
    add_tiles(str(own_atlas), new_tiles([str(room_map)], "twin"))
    result = _localizer(own_atlas).localize(unseen_views()[0][0], CAMERA)
    assert isinstance(result, NotLocalized)
    assert result.reason == "ambiguous"
    assert {one.tile for one in result.alternatives} == {"room", "twin"}
    assert [one.probability for one in result.alternatives] == pytest.approx([0.5, 0.5], abs=0.05)
    assert {one["tile"] for one in result.to_json("view")["alternatives"]} == {"room", "twin"}
    assert result_from_json(result.to_json("view")).alternatives[0].tile in ("room", "twin")  # pyright: ignore


def test_a_similar_tile_that_cannot_rival_the_pose_is_skipped(
    atlas: Path, monkeypatch: pytest.MonkeyPatch
):
    """A similar tile that cannot rival the pose is neither searched nor named."""
    asked = list[str]()
    glance = MapQuery.search_first
    monkeypatch.setattr(
        MapQuery,
        "search_first",
        lambda self: asked.append(self.opened.first.map.kind.name) or glance(self),
    )
    monkeypatch.setattr(Wide, "max_rival_gap", 2.0)
    wide = Wide(num_glanced=1)
    result = _localizer(atlas, wide).localize(unseen_views()[0][0], CAMERA)
    assert isinstance(result, Localization)
    assert asked == ["surf"], "the tile that answers, not the other one"


def test_a_similar_tile_that_is_searched_last_is_a_rival(own_atlas: Path, room_map: Path):
    add_tiles(str(own_atlas), new_tiles([str(room_map)], "twin"))
    result = _localizer(own_atlas, Wide(num_glanced=1)).localize(unseen_views()[0][0], CAMERA)
    assert isinstance(result, NotLocalized)
    assert result.reason == "ambiguous"


def test_two_tiles_of_one_world_agree(own_atlas: Path, room_map: Path):
    """The atlas states that both tiles show the same place."""
    add_tiles(str(own_atlas), new_tiles([str(room_map)], "room", "house"), replaces=True)
    add_tiles(str(own_atlas), new_tiles([str(room_map)], "twin", "house"))
    assert isinstance(_localizer(own_atlas).localize(unseen_views()[0][0], CAMERA), Localization)


def test_georeferenced_tiles_agree_and_give_the_pose_in_the_atlas(
    own_atlas: Path, room_map: Path, tmp_path: Path
):
    from dataclasses import replace

    turned = Rigid3(
        np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]), np.array([2.0, 3.0, 0.0])
    )
    with TopoMetricMap.load(room_map) as topomap:
        replace(
            topomap, georeference=Georeference(GeoPoint(50.87, 4.70, 30.0), turned, "origin")
        ).save(tmp_path / "room.topo")
    add_tiles(str(own_atlas), new_tiles([str(tmp_path / "room.topo")], "room"), replaces=True)
    add_tiles(str(own_atlas), new_tiles([str(tmp_path / "room.topo")], "twin"))
    result = _localizer(own_atlas).localize(unseen_views()[0][0], CAMERA)
    assert isinstance(result, Localization)
    assert result.provenance.atlas_from_cam is not None
    expected = turned @ result.world_from_cam
    assert np.allclose(result.provenance.atlas_from_cam.matrix(), expected.matrix(), atol=1e-6)
    read = result_from_json(result.to_json("view")).provenance.atlas_from_cam
    assert read is not None
    assert np.allclose(read.matrix(), expected.matrix(), atol=1e-6)


@pytest.mark.parametrize("harm", ["map missing", "map rotten", "places missing", "places rotten"])
def test_a_tile_that_cannot_be_read_leaves_the_rest(own_atlas: Path, harm: str):
    tile = Atlas.open(str(own_atlas)).tile("other")
    path = own_atlas / (tile.map if harm.startswith("map") else tile.places).name
    if harm.endswith("rotten"):
        path.write_bytes(b"rotten")
    else:
        path.unlink()
    said = list[str]()
    localizer = _localizer(own_atlas, Wide(), said)
    result = localizer.localize(unseen_views()[0][0], CAMERA)
    assert result.provenance.tile == "room"
    assert result.localized
    of_other = localizer.localize(unseen_views(seed=1)[1][0], CAMERA)
    assert of_other.localized == harm.startswith(
        "places"
    )  # a tile without readable descriptors is searched last
    assert len(said) == 1
    assert said[0].startswith("tile other ")
    assert str(path.name) in said[0]


def test_if_the_likely_tile_is_missing_another_one_refuses(own_atlas: Path):
    """By default, a tile with a clear lead would be searched alone."""
    (own_atlas / Atlas.open(str(own_atlas)).tile("room").map.name).unlink()
    said = list[str]()
    localizer = _localizer(own_atlas, None, said)
    for _ in range(2):
        result = localizer.localize(unseen_views()[0][0], CAMERA)
        assert isinstance(result, NotLocalized)
        assert result.provenance.tile == "other"
    assert len(said) == 1


def test_no_tile_left_is_a_failure(own_atlas: Path):
    shutil.rmtree(own_atlas / "tiles")
    with pytest.raises(AtlasError, match="no tile of the atlas"):
        _localizer(own_atlas).localize(unseen_views()[0][0], CAMERA)


def test_one_tile_can_be_queried_alone_near_a_pose(asked: Localizer):
    image, world_from_cam = unseen_views()[0]
    near = asked.localize(image, CAMERA, world_from_cam, tile_id="room")
    assert isinstance(near, Localization)
    assert isinstance(asked.localize(image, CAMERA, tile_id="other"), NotLocalized)
    with pytest.raises(AtlasError, match="name the one that is meant"):
        asked.localize(image, CAMERA, world_from_cam)
    with pytest.raises(AtlasError, match="has no tile 'attic'"):
        asked.localize(image, CAMERA, tile_id="attic")


def test_tiles_are_closed_if_memory_is_limited(atlas: Path):
    maps = MapCache([], Localizer, 1)
    localizer = Localizer(Atlas.open(str(atlas)), maps=maps)
    for seed in (0, 1, 0):
        localizer.localize(unseen_views(seed)[1][0], CAMERA)
        assert maps.num_open <= 1


def test_the_time_limit_ends_the_search_after_at_least_one_tile(asked: Localizer):
    result = asked.localize(unseen_views(seed=2)[0][0], CAMERA, max_ms=0.001)
    assert result.provenance.tile is not None
