"""Check that edit commands change a tile of an atlas like a map file, and that `undo` restores it
byte-identical."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest

from topoloc.apps.cli import main
from topoloc.atlas.atlas import Atlas
from topoloc.atlas.editing import create_atlas, new_tiles
from topoloc.atlas.manifest import Manifest
from topoloc.mapping.edit import edit_map, undo_edit

Complaint = Callable[..., str]
ORIGIN = "51.5,-0.17,30,90"


def _done(capsys: pytest.CaptureFixture[str], *args: object) -> dict[str, Any]:
    capsys.readouterr()
    assert main([*map(str, args), "--json", "-"]) == 0
    return json.loads(capsys.readouterr().out)


def _bytes(where: Path, tile_id: str) -> bytes:
    atlas = Atlas.open(str(where))
    tile = atlas.tile(tile_id)
    assert atlas.find_problem(tile.tile_id) is None
    return atlas.map_path(tile).read_bytes()


def test_an_edit_of_a_tile_is_that_of_its_map_and_is_taken_back(
    own_atlas: Path,
    room_map: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    alone = Path(shutil.copy(room_map, tmp_path / "alone.topo"))
    before, other = _bytes(own_atlas, "room"), _bytes(own_atlas, "other")
    on_earth = _done(capsys, "georeference", alone, "--origin", ORIGIN)
    assert (
        _done(capsys, "georeference", own_atlas, "--tile", "room", "--origin", ORIGIN) == on_earth
    )
    assert _bytes(own_atlas, "room") == alone.read_bytes() != before
    tile = Atlas.open(str(own_atlas)).tile("room")
    assert tile.geo_box is not None
    assert len(tile.previous) == 1
    pruned = _done(
        capsys,
        "prune",
        own_atlas,
        "--tile",
        "room",
        "--max-mb",
        f"{tile.map.num_bytes * 0.7e-6:.3f}",
    )
    (changes,) = pruned["tiles"]
    assert (changes["tile_id"], changes["bytes"]) == ("room", len(_bytes(own_atlas, "room")))
    assert changes["bytes"] < tile.map.num_bytes
    edits = {one["tile_id"]: one["edits"] for one in _done(capsys, "history", own_atlas)["tiles"]}
    assert [edit["undoable"] for edit in edits["room"]] == [False, True, True]
    assert [edit["undoable"] for edit in edits["other"]] == [False]
    assert _done(capsys, "undo", own_atlas, "--tile", "room")["undone"]["name"].startswith("prune")
    assert _bytes(own_atlas, "room") == alone.read_bytes()
    _done(capsys, "undo", own_atlas, "--tile", "room")
    assert _bytes(own_atlas, "room") == before
    assert Atlas.open(str(own_atlas)).tile("room").previous == ()
    assert _bytes(own_atlas, "other") == other


def test_all_tiles_are_pruned_and_a_failing_one_stays(
    own_atlas: Path, capsys: pytest.CaptureFixture[str]
):
    atlas = Atlas.open(str(own_atlas))
    pruned = _done(capsys, "prune", own_atlas)
    assert {one["tile_id"] for one in pruned["tiles"]} == {"room", "other"}
    atlas.map_path(atlas.tile("other")).write_bytes(b"rotten")
    assert main(["prune", str(own_atlas), "--json", "-"]) == 1
    captured = capsys.readouterr()
    assert [one["tile_id"] for one in json.loads(captured.out)["tiles"]] == ["room"]
    assert "other" in captured.err
    assert captured.err.count("\n") == 1


def test_a_damaged_kept_file_does_not_stop_edits_of_other_tiles(
    own_atlas: Path, complaint: Complaint
):
    Atlas.open(str(own_atlas)).edit("room", _note)
    atlas = Atlas.open(str(own_atlas))
    (kept,) = atlas.tile("room").previous
    assert Manifest.from_bytes(atlas.manifest.to_bytes(), "here").by_id["room"].previous == (kept,)
    path = atlas.store.local_path(kept.name, kept.sha256)
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    assert "checksum" in (atlas.find_problem("room") or "")
    assert "checksum" in complaint("undo", own_atlas, "--tile", "room")
    Atlas.open(str(own_atlas)).edit("other", _note)
    undone = Atlas.open(str(own_atlas)).edit("other", undo_edit)
    assert undone.name == "note"


@pytest.mark.parametrize(
    ("args", "said", "status"),
    [
        (["undo", "ATLAS"], "campus is an atlas: select a tile with --tile (other, room)", 2),
        (["undo", "ATLAS", "--tile", "room"], "tile room: nothing to undo: it is as built", 1),
        (["undo", "ATLAS", "--tile", "attic"], "has no tile 'attic'", 1),
        (["undo", "MAP", "--tile", "room"], "is a map file and has no tile 'room'", 1),
        (["prune", "MAP", "--tile", "room"], "is a map file and has no tile 'room'", 1),
        (["georeference", "ATLAS", "--origin", ORIGIN], "select a tile with --tile", 2),
        (["view", "MAP", "--tile", "room"], "is a map file and has no tile 'room'", 1),
        (["export", "MAP", "out.ply", "--tile", "room"], "is a map file and has no tile", 1),
        (["export", "ATLAS", "out.ply", "--session", "0"], "not of an atlas", 2),
        (["view", "ATLAS", "--tile", "attic"], "has no tile 'attic'", 1),
        (["follow", "ATLAS", "0", "--ros"], "robots need poses of one world", 2),
    ],
)
def test_invalid_arguments_are_one_line(
    args: list[str],
    said: str,
    status: int,
    own_atlas: Path,
    room_map: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    complaint: Complaint,
):
    monkeypatch.chdir(tmp_path)
    paths = {"ATLAS": str(own_atlas), "MAP": str(room_map)}
    assert said in complaint(*(paths.get(arg, arg) for arg in args), status=status)


def _note(path: Path) -> None:
    with edit_map(path) as edit:
        edit.commit(edit.topomap, "note")


def test_an_edit_in_an_object_store_is_taken_back(
    room_map: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    pytest.importorskip("obstore", reason="the extra cluster is not installed")
    monkeypatch.setenv("TOPOLOC_CACHE", str(tmp_path / "cache"))
    where = f"memory:///{uuid4().hex}/campus"
    create_atlas(where, new_tiles([str(room_map)]))
    Atlas.open(where).edit("room", _note)
    assert len(Atlas.open(where).tile("room").previous) == 1
    assert main(["undo", where, "--tile", "room"]) == 0
    atlas = Atlas.open(where)
    assert atlas.map_path(atlas.tile("room")).read_bytes() == room_map.read_bytes()
