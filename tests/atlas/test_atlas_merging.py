"""Test `topoloc merge` of atlases: tiles, worlds and joins stay as they were, and a conflict of two
tiles changes nothing."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from topoloc.apps.cli import main
from topoloc.atlas.atlas import Atlas
from topoloc.atlas.editing import add_joins, create_atlas, new_tiles
from topoloc.atlas.joint_worlds import Join
from topoloc.errors import AtlasError
from topoloc.geometry.rigid import Rigid3

Complaint = Callable[..., str]


def _atlas(where: Path, *maps: Path, tile_id: str | None = None, world: str | None = None) -> str:
    create_atlas(str(where), new_tiles([str(path) for path in maps], tile_id, world))
    return str(where)


def test_tiles_of_both_are_there_with_their_files(
    room_map: Path, other_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    first = _atlas(tmp_path / "first", room_map)
    out = tmp_path / "both"
    assert main(["merge", first, str(other_map), str(out), "--json", "-"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert [tile["id"] for tile in facts["tiles"]] == ["other", "room"]
    atlas = Atlas.open(str(out))
    assert [atlas.find_problem(tile.tile_id) for tile in atlas.manifest.tiles] == [None, None]
    assert atlas.map_path(atlas.tile("room")).read_bytes() == room_map.read_bytes()
    assert len(Atlas.open(first).manifest.tiles) == 1


def test_joins_stay_and_worlds_of_one_name_are_two(room_map: Path, other_map: Path, tmp_path: Path):
    pair = _atlas(tmp_path / "pair", room_map, other_map)
    tiles = Atlas.open(pair).manifest.by_id
    add_joins(
        pair,
        [Join("other", "room", Rigid3(np.eye(3), np.array([1.0, 2.0, 3.0])), 1e-6 * np.eye(6), 5)],
        tiles,
    )
    same_name = _atlas(tmp_path / "alone", room_map, tile_id="twin", world="room")
    merged = Atlas.merge([pair, same_name], str(tmp_path / "all")).manifest
    assert [join.pair for join in merged.joins] == [("other", "room")]
    by_id = merged.by_id
    assert by_id["room"].from_world_of(by_id["other"]) is not None
    assert by_id["twin"].world == "room-2"
    assert by_id["twin"].from_world_of(by_id["room"]) is None


def test_a_map_that_both_hold_is_one_tile_and_makes_their_worlds_one(
    room_map: Path, other_map: Path, tmp_path: Path
):
    one = _atlas(tmp_path / "one", room_map, other_map, world="campus")
    two = _atlas(tmp_path / "two", room_map, world="yard")
    merged = Atlas.merge([one, two, str(room_map)], str(tmp_path / "all")).manifest
    assert {tile.tile_id: tile.world for tile in merged.tiles} == {
        "room": "campus",
        "other": "campus",
    }


def test_two_maps_of_one_name_are_refused(
    room_map: Path, other_map: Path, tmp_path: Path, complaint: Complaint
):
    one, two = (
        _atlas(tmp_path / "one", room_map),
        _atlas(tmp_path / "two", other_map, tile_id="room"),
    )
    with pytest.raises(AtlasError, match="has a tile room too"):
        Atlas.merge([one, two], str(tmp_path / "all"))
    assert "is an atlas already" in complaint("merge", one, str(other_map), two)


def test_a_rotten_tile_is_named_and_no_atlas_made(room_map: Path, other_map: Path, tmp_path: Path):
    one, two = _atlas(tmp_path / "one", room_map), _atlas(tmp_path / "two", other_map)
    damaged = Atlas.open(two)
    damaged.map_path(damaged.tile("other")).write_bytes(b"rotten")
    with pytest.raises(AtlasError, match="checksum is another"):
        Atlas.merge([one, two], str(tmp_path / "all"))
    with pytest.raises(AtlasError, match="is no atlas"):
        Atlas.open(str(tmp_path / "all"))
