"""Test joins: they are adjusted as a pose graph of worlds, stored in the manifest, and refused
if impossible."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from topoloc.atlas.joint_worlds import Join, adjust_joins
from topoloc.atlas.manifest import Manifest, PlacesFile, StoredFile, Tile
from topoloc.errors import AtlasError
from topoloc.geometry.geodesy import GeoPoint, Georeference
from topoloc.geometry.rigid import Rigid3, exp_so3

SIGMA_M, SIGMA_RAD = 0.02, 0.005
COVARIANCE = np.diag([SIGMA_M**2] * 3 + [SIGMA_RAD**2] * 3)
# a_from_room of each tile's world
WORLDS = {
    name: Rigid3(exp_so3(np.array([0.1 * k, -0.2 * k, 0.7 * k])), np.array([3.0 * k, -k, 0.1 * k]))
    for k, name in enumerate("abcd")
}
EACH_ITS_OWN = {name: name for name in WORLDS}


def _join(first: str, second: str, off: Rigid3 | None = None, num_agreeing: int = 20) -> Join:
    true = WORLDS[first] @ WORLDS[second].inverse()
    return Join(first, second, (off or Rigid3.identity()) @ true, COVARIANCE, num_agreeing)


def _off(seed: int) -> Rigid3:
    return Rigid3.exp(np.random.default_rng(seed).multivariate_normal(np.zeros(6), COVARIANCE))


def _tile(
    name: str,
    world: str | None = None,
    georeference: Georeference | None = None,
    contents: str = "ab",
) -> Tile:
    stored = StoredFile(f"tiles/{name}-0123.topo", contents * 32, 10)
    box = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 5.5]])
    places = PlacesFile(f"tiles/{name}-0123.places", stored.sha256, 10, {"surf": "12ab"})
    return Tile(
        name,
        stored,
        places,
        "0" * 16,
        1,
        ("surf",),
        4,
        ("walk",),
        300.0,
        box,
        world or name,
        georeference,
        None,
        None,
    )


def _manifest(joins: list[Join], **worlds: str) -> Manifest:
    return Manifest().with_tiles(
        {name: _tile(name, worlds.get(name)) for name in WORLDS}, 1.0, joins
    )


def test_three_worlds_in_a_loop_share_the_closing_error():
    joins = [_join("a", "b", _off(1)), _join("b", "c", _off(2)), _join("a", "c", _off(3))]
    adjusted, places = adjust_joins(joins, EACH_ITS_OWN, {})
    misses = []
    for name in "bc":
        true = WORLDS["a"] @ WORLDS[name].inverse()
        misses.append(np.linalg.norm((places[name].joint_from_world @ true.inverse()).log()[:3]))
        assert places[name].joint == "a"
    by_way_of_b = joins[0].first_from_second @ joins[1].first_from_second
    direct = joins[2].first_from_second
    apart = np.linalg.norm((by_way_of_b @ direct.inverse()).log()[:3])
    assert apart > 0.02  # the loop does not close, and each join bears some of that
    for join in adjusted:
        assert join.residual is not None
        assert 0.1 < join.residual < 6.0
    assert max(misses) < 0.08


def test_a_join_that_contradicts_more_images_is_dropped():
    wrong = Rigid3(np.eye(3), np.array([5.0, 0.0, 0.0]))
    joins = [
        _join("a", "b"),
        _join("b", "c"),
        _join("a", "c", wrong, num_agreeing=9),
        _join("c", "d"),
    ]
    adjusted, places = adjust_joins(joins, EACH_ITS_OWN, {})
    assert [(join.pair, join.residual is None) for join in adjusted] == [
        (("a", "b"), False),
        (("a", "c"), True),
        (("b", "c"), False),
        (("c", "d"), False),
    ]
    for name in "bcd":
        assert np.allclose(
            places[name].joint_from_world.matrix(),
            (WORLDS["a"] @ WORLDS[name].inverse()).matrix(),
            atol=1e-6,
        )


def test_uncertainty_grows_along_the_path():
    _, places = adjust_joins([_join("a", "b"), _join("b", "c"), _join("c", "d")], EACH_ITS_OWN, {})
    traces = [float(np.trace(places[name].covariance)) for name in "abcd"]
    assert traces[0] == 0.0
    assert traces == sorted(traces)


def test_joins_do_not_move_georeferenced_worlds():
    """Georeferences place b and d 1 km apart. Joins that connect them by c are wrong, so the weaker
    join is dropped."""
    on_earth: Mapping[str, Rigid3] = {
        "b": Rigid3.identity(),
        "d": Rigid3(np.eye(3), np.array([1000.0, 0.0, 0.0])),
    }
    adjusted, places = adjust_joins(
        [_join("b", "c", num_agreeing=30), _join("c", "d", num_agreeing=10)], EACH_ITS_OWN, on_earth
    )
    assert [join.residual is None for join in adjusted] == [False, True]
    assert places.keys() == {"b", "c"}
    assert places["c"].joint == "b"


def test_tiles_of_one_world_are_joined_together():
    manifest = _manifest([_join("a", "c")], a="house", b="house")
    places = {tile.tile_id: tile.in_joint_world.joint for tile in manifest.tiles}
    assert places == {"a": "c", "b": "c", "c": "c", "d": "d"}
    assert manifest.by_id["b"].from_world_of(manifest.by_id["d"]) is None
    way = manifest.by_id["b"].from_world_of(manifest.by_id["c"])
    assert way is not None
    assert np.allclose(way.matrix(), (WORLDS["a"] @ WORLDS["c"].inverse()).matrix(), atol=1e-9)
    assert _manifest([_join("a", "b")], a="house", b="house").joins == ()  # one world needs no join


def test_one_tile_on_earth_is_enough():
    known = Georeference(
        GeoPoint(50.0, 4.0, 30.0), Rigid3(np.eye(3), np.array([7.0, 0.0, 0.0])), "origin"
    )
    tiles = {name: _tile(name, georeference=known if name == "c" else None) for name in WORLDS}
    manifest = Manifest().with_tiles(tiles, 1.0, [_join("a", "b"), _join("b", "c")])
    pose = manifest.by_id["a"].atlas_from_world
    assert pose is not None
    assert np.allclose(
        pose.matrix(),
        (known.enu_from_world @ WORLDS["c"] @ WORLDS["a"].inverse()).matrix(),
        atol=1e-6,
    )
    assert manifest.by_id["d"].atlas_from_world is None
    place = manifest.georeference_of(manifest.by_id["a"])
    assert place is not None
    assert np.allclose(
        place.geopoint(np.zeros(3)).ecef(),
        known.geopoint((WORLDS["c"] @ WORLDS["a"].inverse()).translation).ecef(),
        atol=1e-3,
    )
    assert not np.isnan(manifest.geo_boxes[0]).any()


def test_written_joins_are_read():
    wrong = Rigid3(np.eye(3), np.array([5.0, 0.0, 0.0]))
    written = _manifest([_join("a", "b", _off(4)), _join("b", "c"), _join("a", "c", wrong, 5)])
    read = Manifest.from_bytes(written.to_bytes(), "here")
    for join, again in zip(written.joins, read.joins, strict=True):
        assert (again.pair, again.num_agreeing, again.residual) == (
            join.pair,
            join.num_agreeing,
            join.residual,
        )
        assert np.allclose(
            again.first_from_second.matrix(), join.first_from_second.matrix(), atol=1e-12
        )
        assert np.array_equal(again.covariance, join.covariance)
    for tile, again in zip(written.tiles, read.tiles, strict=True):
        assert (again.joint is None) == (tile.joint is None)
        assert again.in_joint_world.joint == tile.in_joint_world.joint
        assert np.allclose(
            again.in_joint_world.joint_from_world.matrix(),
            tile.in_joint_world.joint_from_world.matrix(),
            atol=1e-12,
        )
        assert np.allclose(again.in_joint_world.covariance, tile.in_joint_world.covariance)


def test_a_manifest_of_before_there_were_joins_is_read():
    data = json.loads(_manifest([]).to_bytes())
    assert "joins" not in data
    assert "joint" not in data["tiles"][0]
    assert Manifest.from_bytes(json.dumps(data).encode(), "here").joins == ()


def test_a_tile_that_goes_or_is_replaced_loses_its_joins():
    before = _manifest([_join("a", "b"), _join("b", "c"), _join("c", "d")])
    without = before.with_tiles(
        {name: tile for name, tile in before.by_id.items() if name != "b"}, 2.0
    )
    assert [join.pair for join in without.joins] == [("c", "d")]
    assert without.by_id["a"].joint is None
    replaced = before.with_tiles(before.by_id | {"c": _tile("c", contents="cd")}, 2.0)
    assert [join.pair for join in replaced.joins] == [("a", "b")]
    assert replaced.by_id["c"].joint is None
    again = before.with_tiles(before.by_id, 2.0, [_join("c", "d", num_agreeing=99)])
    assert [join.num_agreeing for join in again.joins] == [20, 20, 99]


_NAN = float("nan")
_WRONG: list[tuple[list[Any], Any]] = [
    (["joins"], {}),
    (["joins", 0], []),
    (["joins", 0, "first"], "nobody"),
    (["joins", 0, "first"], "b"),
    (["joins", 0, "second"], "../b"),
    (["joins", 0, "covariance"], [[_NAN] * 6] * 6),
    (["joins", 0, "covariance"], [[1e300] * 6] * 6),
    (["joins", 0, "covariance"], (-np.eye(6)).tolist()),
    (["joins", 0, "covariance"], np.triu(np.ones((6, 6))).tolist()),
    (["joins", 0, "covariance"], np.eye(5).tolist()),
    (["joins", 0, "covariance"], "much"),
    (["joins", 0, "first_from_second"], (2.0 * np.eye(4)[:3]).tolist()),
    (["joins", 0, "first_from_second"], (np.diag([1.0, 1.0, -1.0, 1.0])[:3]).tolist()),
    (["joins", 0, "first_from_second", 0, 3], _NAN),
    (["joins", 0, "first_from_second", 0, 3], 1e12),
    (["joins", 0, "num_agreeing"], -1),
    (["joins", 0, "residual"], "none"),
    (["tiles", 1, "joint"], 3),
    (["tiles", 1, "joint", "world"], "../a"),
    (["tiles", 1, "joint", "joint_from_world"], [[1.0, 2.0]]),
    (["tiles", 1, "joint", "covariance"], [[_NAN] * 6] * 6),
]


@pytest.mark.parametrize(("keys", "value"), _WRONG)
def test_damage_is_refused_in_one_line(keys: list[Any], value: Any):
    data = json.loads(_manifest([_join("a", "b")]).to_bytes())
    at = data
    for key in keys[:-1]:
        at = at[key]
    at[keys[-1]] = value
    with pytest.raises(
        AtlasError, match=r"^here is no manifest of an atlas, or a damaged one: .+$"
    ) as caught:
        Manifest.from_bytes(json.dumps(data).encode(), "here")
    assert "\n" not in str(caught.value)


def test_two_joins_of_the_same_tiles_are_refused():
    data = json.loads(_manifest([_join("a", "b")]).to_bytes())
    data["joins"] *= 2
    with pytest.raises(AtlasError, match="two joins of the same tiles"):
        Manifest.from_bytes(json.dumps(data).encode(), "here")
