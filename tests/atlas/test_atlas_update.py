"""Test `topoloc update ATLAS`: recordings update their tiles exactly as a map file, and parallel
changes are kept."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import pytest

from tiny_world import write_stereo_recording
from topoloc.apps.cli import main
from topoloc.atlas.atlas import Atlas
from topoloc.atlas.editing import NewTile, add_joins, add_tiles, create_atlas, new_tiles
from topoloc.atlas.joint_worlds import Join
from topoloc.atlas.manifest import Tile
from topoloc.errors import AtlasError, TrajectoryError
from topoloc.geometry.rigid import Rigid3
from topoloc.lifelong.tiles.tile_joining import find_best_tile
from topoloc.localization.provenance import Provenance
from topoloc.localization.result import Localization
from topoloc.mapping.edit import edit_map
from topoloc.mapping.topomap import TopoMetricMap

Complaint = Callable[..., str]


@pytest.fixture(scope="module")
def sessions(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return recordings of both rooms of the atlas, and of a third room."""
    folder = tmp_path_factory.mktemp("sessions")
    rows = {
        "evening": (0, np.arange(0.25, 5.5, 0.25)),
        "night": (1, np.arange(0.25, 5.5, 0.25)),
        "elsewhere": (2, np.arange(0.0, 6.0, 0.5)),
    }
    return {
        name: write_stereo_recording(folder / name, seed, indices.tolist())
        for name, (seed, indices) in rows.items()
    }


@pytest.fixture(params=["folder", "memory"])
def somewhere(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param == "folder":
        return str(tmp_path / "campus")
    pytest.importorskip("obstore", reason="the extra cluster is not installed")
    return f"memory:///{uuid4().hex}/campus"


def _updated(capsys: pytest.CaptureFixture[str], status: int, *args: object) -> dict[str, Any]:
    capsys.readouterr()
    assert main(["update", *map(str, args), "--json", "-"]) == status
    return json.loads(capsys.readouterr().out)


def _map(where: object, tile_id: str) -> bytes:
    atlas = Atlas.open(str(where))
    assert atlas.find_problem(tile_id) is None
    return atlas.map_path(atlas.tile(tile_id)).read_bytes()


def _note(path: Path, text: str) -> None:
    """Edit only the history of a map."""
    with edit_map(path) as edit:
        edit.commit(edit.topomap, text)


def _notes(where: str, tile_id: str) -> list[str]:
    atlas = Atlas.open(where)
    with TopoMetricMap.load(atlas.map_path(atlas.tile(tile_id))) as topomap:
        return [edit.name for edit in topomap.edits][1:]


def test_each_recording_joins_its_tile_as_it_would_join_the_map(
    own_atlas: Path,
    sessions: dict[str, Path],
    room_map: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    other = _map(own_atlas, "other")
    updated = _updated(
        capsys, 1, own_atlas, sessions["elsewhere"], sessions["evening"], "--light", "dusk"
    )
    refused, joined = updated["recordings"]
    assert (refused["state"], joined["state"], joined["tile_id"]) == ("failed", "updated", "room")
    assert "no tile recognises it" in refused["reason"]
    alone = Path(shutil.copy(room_map, tmp_path / "alone.topo"))
    assert main(["update", str(alone), str(sessions["evening"]), "--light", "dusk"]) == 0
    assert _map(own_atlas, "room") == alone.read_bytes()
    assert _map(own_atlas, "other") == other
    tile = Atlas.open(str(own_atlas)).tile("room")
    assert (tile.num_nodes, tile.map.num_bytes) == (joined["num_nodes"], joined["changes"]["bytes"])
    before = (own_atlas / "atlas.json").read_bytes()
    again = _updated(capsys, 0, own_atlas, sessions["evening"])
    assert [(one["state"], one["tile_id"], one["reason"]) for one in again["recordings"]] == [
        ("there", "room", None)
    ]
    assert (own_atlas / "atlas.json").read_bytes() == before


def test_a_named_tile_is_used_without_a_search(
    own_atlas: Path, sessions: dict[str, Path], capsys: pytest.CaptureFixture[str]
):
    """A recording of another tile does not fit the named one. The other recordings continue."""
    before = _map(own_atlas, "room")
    updated = _updated(
        capsys, 1, own_atlas, sessions["evening"], sessions["night"], "--tile", "other"
    )
    assert [(one["state"], one["tile_id"]) for one in updated["recordings"]] == [
        ("failed", "other"),
        ("updated", "other"),
    ]
    assert "no map is changed" in updated["recordings"][0]["reason"]
    assert _map(own_atlas, "room") == before


@pytest.mark.parametrize(
    ("args", "said", "status"),
    [
        (["ATLAS", "SEQ", "--tile", "attic"], "has no tile 'attic'", 1),
        (["ATLAS"], "at least one recording", 2),
        (["ATLAS", "SEQ", "--joined", "poses.tum"], "--joined needs a map file", 2),
        (["MAP", "SEQ", "--tile", "room"], "--tile and --ray need an atlas", 2),
        (["MAP", "SEQ", "--ray", "local"], "--tile and --ray need an atlas", 2),
    ],
)
def test_invalid_arguments_are_one_line(
    args: list[str],
    said: str,
    status: int,
    own_atlas: Path,
    room_map: Path,
    sessions: dict[str, Path],
    complaint: Complaint,
):
    paths = {"ATLAS": own_atlas, "MAP": room_map, "SEQ": sessions["evening"]}
    assert said in complaint("update", *(paths.get(arg, arg) for arg in args), status=status)


def test_a_tile_replaced_meanwhile_is_not_overwritten(
    somewhere: str, room_map: Path, other_map: Path
):
    create_atlas(somewhere, [NewTile("hall", room_map, "campus", "ab" * 32)])
    num_nodes = list[int]()

    def edit(path: Path) -> int:
        if not num_nodes:
            add_tiles(somewhere, [NewTile("hall", other_map, "campus")], replaces=True)
        with TopoMetricMap.load(path) as topomap:
            num_nodes.append(len(topomap.summaries))
        _note(path, f"try {len(num_nodes)}")
        return len(num_nodes)

    tries = Atlas.open(somewhere).edit("hall", edit)
    tile = Atlas.open(somewhere).tile("hall")
    assert (tries, tile.num_nodes, tile.world, tile.recipe) == (2, num_nodes[1], "campus", None)
    assert num_nodes[0] != num_nodes[1]
    assert _notes(somewhere, "hall") == ["try 2"]


def test_always_faster_writers_end_the_edit(somewhere: str, room_map: Path, tmp_path: Path):
    create_atlas(somewhere, new_tiles([str(room_map)], "hall"))
    theirs = Path(shutil.copy(room_map, tmp_path / "theirs.topo"))

    def edit(path: Path) -> None:
        _note(path, "ours")
        _note(theirs, "theirs")
        add_tiles(somewhere, new_tiles([str(theirs)], "hall"), replaces=True)

    with pytest.raises(AtlasError, match="was replaced by others 5 times"):
        Atlas.open(somewhere).edit("hall", edit)
    assert _notes(somewhere, "hall") == ["theirs"] * 5
    assert Atlas.open(somewhere).tile("hall").num_nodes > 0


def test_joins_world_and_recipe_stay(somewhere: str, room_map: Path, other_map: Path):
    create_atlas(
        somewhere,
        [NewTile("hall", room_map, "hall", "ab" * 32), NewTile("yard", other_map, "yard")],
    )
    tiles = Atlas.open(somewhere).manifest.by_id
    pose = Rigid3(np.eye(3), np.array([3.0, 1.0, 0.0]))
    before = add_joins(somewhere, [Join("hall", "yard", pose, 1e-4 * np.eye(6), 20)], tiles)
    Atlas.open(somewhere).edit("yard", lambda path: _note(path, "one"))
    Atlas.open(somewhere).edit("hall", lambda path: _note(path, "two"))
    after = Atlas.open(somewhere).manifest
    tile = after.by_id["hall"]
    assert [join.to_json() for join in after.joins] == [join.to_json() for join in before.joins]
    assert {one.in_joint_world.joint for one in after.tiles} == {"hall"}
    assert (tile.recipe, tile.world, _notes(somewhere, "hall")) == ("ab" * 32, "hall", ["two"])
    assert tile.map.sha256 != before.by_id["hall"].map.sha256


def test_a_failure_leaves_no_file_and_changes_nothing(
    own_atlas: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    scratch = tmp_path / "scratch"
    (scratch / "topoloc-tile-left").mkdir(parents=True)  # of one that was killed
    monkeypatch.setattr("tempfile.tempdir", str(scratch))
    before = (own_atlas / "atlas.json").read_bytes()

    def fails(path: Path) -> None:
        _note(path, "in vain")
        raise TrajectoryError("it does not fit")

    with pytest.raises(TrajectoryError, match="does not fit"):
        Atlas.open(str(own_atlas)).edit("room", fails)
    file = own_atlas / Atlas.open(str(own_atlas)).tile("room").map.name
    file.write_bytes(file.read_bytes()[:-1] + b"x")
    with pytest.raises(AtlasError, match="its checksum is another"):
        Atlas.open(str(own_atlas)).edit("room", lambda path: None)
    assert (own_atlas / "atlas.json").read_bytes() == before
    assert list(scratch.iterdir()) == []


def _answers(**counts: int) -> list[Localization]:
    def one(tile_id: str) -> Localization:
        return Localization(
            Rigid3.identity(), np.eye(6), 1.0, 0, [], 10, 10, provenance=Provenance(tile=tile_id)
        )

    return [one(tile_id) for tile_id, number in counts.items() for _ in range(number)]


def test_a_recording_belongs_to_the_tile_of_most_images_or_to_none(own_atlas: Path, room_map: Path):
    add_tiles(str(own_atlas), [NewTile("annex", room_map, "room")])
    tiles = Atlas.open(str(own_atlas)).manifest.by_id

    def chosen(**counts: int) -> Tile:
        return find_best_tile("walk", 12, _answers(**counts), tiles)

    assert chosen(room=3).tile_id == "room"
    assert chosen(room=6, other=2).tile_id == "room"
    assert chosen(room=5, annex=6).tile_id == "annex", "both are of one world"
    assert chosen(room=3, annex=3).tile_id == "annex"
    for counts, said in (
        ({"room": 2}, "no tile recognises it: room knows 2 of 12"),
        ({}, "none knows any"),
    ):
        with pytest.raises(TrajectoryError, match=said):
            chosen(**counts)
    with pytest.raises(
        TrajectoryError, match="looks like several tiles: room knows 4, other knows 3 of 12"
    ):
        chosen(room=4, other=3)
