"""Test `topoloc atlas`, and the commands that accept an atlas in place of a map."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from built_room import unseen_views, write_pictures
from schemas import check_result
from topoloc.apps.cli import main
from topoloc.atlas.atlas import Atlas
from topoloc.atlas.manifest import Tile
from topoloc.errors import ObjectStoreError

Complaint = Callable[..., str]


@pytest.fixture(scope="module")
def of_both(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return two images of one room, then one of the other."""
    views = [*unseen_views()[:2], unseen_views(seed=1)[1]]
    return write_pictures(tmp_path_factory.mktemp("both") / "pictures", views)


def _json(capsys: pytest.CaptureFixture[str], *args: object) -> str:
    capsys.readouterr()
    assert main([str(arg) for arg in (*args, "--json", "-")]) == 0
    return capsys.readouterr().out


def test_an_atlas_is_made_added_to_and_emptied(
    room_map: Path, other_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    where = tmp_path / "campus"
    made = json.loads(_json(capsys, "atlas", "create", where, room_map))
    assert (made["serial"], made["num_tiles"], [tile["id"] for tile in made["tiles"]]) == (
        1,
        1,
        ["room"],
    )
    added = json.loads(
        _json(capsys, "atlas", "add", where, other_map, "--id", "annex", "--world", "house")
    )
    assert [(tile["id"], tile["world"]) for tile in added["tiles"]] == [
        ("annex", "house"),
        ("room", "room"),
    ]
    assert added["num_nodes"] == sum(tile["num_nodes"] for tile in added["tiles"])
    assert main(["atlas", "remove", str(where), "room"]) == 0
    assert main(["atlas", "info", str(where), "--check"]) == 0
    printed = capsys.readouterr().out
    assert "annex" in printed
    assert "check  ok" in printed
    assert json.loads(_json(capsys, "info", where)) == json.loads(
        _json(capsys, "atlas", "info", where)
    )


def test_the_history_is_that_of_each_tile(
    own_atlas: Path, room_map: Path, capsys: pytest.CaptureFixture[str]
):
    told = json.loads(_json(capsys, "history", own_atlas))
    assert [tile["tile_id"] for tile in told["tiles"]] == ["other", "room"]
    alone = json.loads(_json(capsys, "history", room_map))["edits"]
    assert told["tiles"][1]["edits"] == [edit | {"undoable": False} for edit in alone]
    assert all("undoable" in edit for tile in told["tiles"] for edit in tile["edits"])
    next((own_atlas / "tiles").glob("other-*.topo")).unlink()
    assert main(["history", str(own_atlas)]) == 1
    said = capsys.readouterr()
    assert "error: tile other: " in said.err
    assert "tile room" in said.out


def test_a_history_ends_if_the_store_is_silent(
    atlas: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    asked = list[str]()

    def silent(self: Atlas, tile: Tile) -> Path:
        asked.append(tile.tile_id)
        raise ObjectStoreError("the store does not answer")

    monkeypatch.setattr(Atlas, "map_path", silent)
    assert main(["history", str(atlas)]) == 1
    assert capsys.readouterr().err == "error: the store does not answer\n"
    assert len(asked) == 1


def test_check_names_the_tile_that_is_damaged(own_atlas: Path, capsys: pytest.CaptureFixture[str]):
    next((own_atlas / "tiles").glob("other-*.topo")).write_bytes(b"")
    assert main(["atlas", "info", str(own_atlas), "--check"]) == 1
    assert "error: tile other: tiles/other-" in capsys.readouterr().err


def test_pictures_are_localized_in_their_tiles(
    atlas: Path, of_both: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    lines = [json.loads(line) for line in _json(capsys, "localize", atlas, of_both).splitlines()]
    assert [line["tile"] for line in lines] == ["room", "room", "other"]
    for line in lines:
        assert line["localized"]
        check_result(line)
    assert main(["localize", str(atlas), str(of_both), "--tum", str(tmp_path / "both.tum")]) == 0
    assert "poses of 2 tiles, each in its tile's world" in capsys.readouterr().err
    assert main(["localize", str(atlas), str(of_both)]) == 0
    assert "tile other" in capsys.readouterr().out


def test_near_excludes_tiles_known_to_be_elsewhere(
    own_atlas: Path,
    room_map: Path,
    of_both: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    shutil.copy(room_map, tmp_path / "room.topo")
    assert main(["georeference", str(tmp_path / "room.topo"), "--origin", "50.87,4.7,30,0"]) == 0
    assert main(["atlas", "add", str(own_atlas), str(tmp_path / "room.topo"), "--replace"]) == 0
    answers = dict[str, list[tuple[bool, str]]]()
    for place in ("50.87,4.7,50", "-33.9,151.2,50"):
        capsys.readouterr()
        main(["localize", str(own_atlas), str(of_both), f"--near={place}", "--json", "-"])
        lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
        answers[place] = [(line["localized"], line["tile"]) for line in lines]
    near, far = answers.values()
    assert near == [(True, "room"), (True, "room"), (True, "other")]
    assert far == [(False, "other"), (False, "other"), (True, "other")]


def test_truth_is_that_of_one_tile(atlas: Path, of_both: Path, capsys: pytest.CaptureFixture[str]):
    """The truth of the third image is wrongly given in the room, and its pose is in the other tile:
    a false accept."""
    evaluation = json.loads(_json(capsys, "evaluate", atlas, of_both, "--tile", "room"))
    assert (
        evaluation["num_queries"],
        evaluation["num_localized"],
        evaluation["false_accepts"],
    ) == (3, 2, 1)
    assert evaluation["median_translation_m"] < 0.05
    of_first = json.loads(
        _json(
            capsys,
            "evaluate",
            atlas,
            f"{of_both}@0:2",
            "--tile",
            "room",
            "--elsewhere",
            f"{of_both}@2:3",
        )
    )
    assert (of_first["num_localized"], of_first["false_accepts"]) == (2, 1)
    assert np.isclose(of_first["median_translation_m"], evaluation["median_translation_m"])


def test_a_picture_is_explained_in_its_tile(
    atlas: Path, of_both: Path, capsys: pytest.CaptureFixture[str]
):
    facts = json.loads(_json(capsys, "explain", atlas, f"{of_both}@2"))
    assert facts["tiles"][0] == "atlas: in tile other"
    assert facts["tiles"][1].startswith("most similar tiles: other ")
    assert facts["tried"][0]["source"] == "retrieval"


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["atlas", "create", "ATLAS"], "is an atlas already"),
        (["atlas", "add", "ATLAS", "MAP"], "has a tile room already"),
        (["atlas", "remove", "ATLAS", "attic"], "has no tile 'attic'"),
        (["atlas", "info", "nowhere"], "is no atlas"),
        (["atlas", "add", "ATLAS", "MAP", "--id", "a/b"], "no tile can be called 'a/b'"),
        (["evaluate", "ATLAS", "PICTURES", "--tile", "attic"], "has no tile 'attic'"),
        (["evaluate", "MAP", "PICTURES", "--tile", "room"], "tiles are parts of an atlas"),
        (["localize", "MAP", "PICTURES", "--near", "50,4,100"], "the tiles of an atlas"),
        (["slam", "ATLAS", "out.tum"], "no known recording"),
    ],
)
def test_known_failures_are_one_line(
    args: list[str], said: str, own_atlas: Path, room_map: Path, of_both: Path, complaint: Complaint
):
    paths = {"ATLAS": own_atlas, "MAP": room_map, "PICTURES": of_both}
    assert said in complaint(*(paths.get(arg, arg) for arg in args))


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["atlas", "add", "ATLAS"], "at least one map"),
        (["atlas", "info", "ATLAS", "MAP"], "info takes an atlas alone"),
        (["atlas", "remove", "ATLAS", "room", "--id", "x"], "--id"),
        (["atlas", "remove", "ATLAS", "room", "--world", "x"], "--world"),
        (["atlas", "create", "ATLAS", "--replace"], "--replace"),
        (["atlas", "create", "ATLAS", "--check"], "--check"),
        (["localize", "ATLAS", "PICTURES", "--camera", "map"], "cameras of their own"),
        (["localize", "ATLAS", "PICTURES", "--near", "here"], "--near"),
        (["evaluate", "ATLAS", "PICTURES"], "--tile"),
        (["evaluate", "ATLAS", "PICTURES", "--tile", "room", "--report", "x.html"], "--report"),
    ],
)
def test_wrong_usage_is_an_error(
    args: list[str], said: str, own_atlas: Path, room_map: Path, of_both: Path, complaint: Complaint
):
    paths = {"ATLAS": own_atlas, "MAP": room_map, "PICTURES": of_both}
    assert said in complaint(*(paths.get(arg, arg) for arg in args), status=2)
