"""Check that tiles of parallel writers survive, and that files stay while readers may need them."""

from __future__ import annotations

import os
import shutil
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from uuid import uuid4

import pytest
from msgspec import structs

from topoloc.atlas import editing
from topoloc.atlas.atlas import Atlas
from topoloc.atlas.editing import NewTile, add_tiles, create_atlas, new_tiles, remove_tiles
from topoloc.atlas.manifest import Tile
from topoloc.atlas.store import Store
from topoloc.errors import AtlasError

NUM_WRITES = {"folder": 25, "memory": 12, "s3": 12}


@pytest.fixture(params=list(NUM_WRITES))
def somewhere(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """Return the address of a new atlas: a folder, a store in memory, or S3."""
    if request.param == "folder":
        return str(tmp_path / "campus")
    if request.param == "s3":
        return f"{request.getfixturevalue('s3_bucket')}/campus"
    pytest.importorskip("obstore", reason="the extra cluster is not installed")
    return f"memory:///{uuid4().hex}/campus"


def _tiles(where: str) -> list[str]:
    return [tile.tile_id for tile in Atlas.open(where).manifest.tiles]


def test_tiles_come_and_go(somewhere: str, room_map: Path, other_map: Path):
    assert create_atlas(somewhere, new_tiles([str(room_map)])).serial == 1
    assert add_tiles(somewhere, new_tiles([str(other_map)], "annex")).serial == 2
    assert _tiles(somewhere) == ["annex", "room"]
    read = Atlas.open(somewhere)
    assert [read.find_problem(tile.tile_id) for tile in read.manifest.tiles] == [None, None]
    assert read.map_path(read.tile("room")).read_bytes() == room_map.read_bytes()
    assert remove_tiles(somewhere, ["room"]).serial == 3
    assert _tiles(somewhere) == ["annex"]


def test_two_tiles_of_one_id_are_refused(somewhere: str, room_map: Path, other_map: Path):
    create_atlas(somewhere, new_tiles([str(room_map)]))
    with pytest.raises(AtlasError, match="has a tile room already"):
        add_tiles(somewhere, new_tiles([str(other_map)], "room"))
    with pytest.raises(AtlasError, match="two tiles would be called room"):
        new_tiles([str(room_map), f"elsewhere/{room_map.name}"])
    with pytest.raises(AtlasError, match="is an atlas already"):
        create_atlas(somewhere, [])
    assert Atlas.open(somewhere).manifest.serial == 1


def test_an_atlas_is_created_on_request(somewhere: str, room_map: Path, other_map: Path):
    with pytest.raises(AtlasError, match="is no atlas"):
        add_tiles(somewhere, new_tiles([str(room_map)]))
    assert add_tiles(somewhere, new_tiles([str(room_map)]), creates=True).serial == 1
    assert add_tiles(somewhere, new_tiles([str(other_map)]), creates=True).serial == 2
    assert _tiles(somewhere) == ["other", "room"]


def test_a_tile_with_the_same_recipe_is_the_same_tile(
    somewhere: str, room_map: Path, other_map: Path
):
    made = NewTile("room", room_map, "room", recipe="ab" * 32)
    add_tiles(somewhere, [made], creates=True)
    assert add_tiles(somewhere, [made]).by_id["room"].recipe == made.recipe
    for other in (replace(made, recipe="cd" * 32), replace(made, recipe=None)):
        with pytest.raises(AtlasError, match="has a tile room already"):
            add_tiles(somewhere, [replace(other, path=other_map)])
    assert (
        add_tiles(somewhere, new_tiles([str(other_map)], "room"), replaces=True)
        .by_id["room"]
        .recipe
        is None
    )


def test_partial_files_of_a_killed_writer_are_removed(
    room_map: Path, other_map: Path, tmp_path: Path
):
    where = tmp_path / "campus"
    create_atlas(str(where), new_tiles([str(room_map)]))
    left = where / "tiles" / ".hall-0123456789ab.topo.0123456789abcdef.part"
    left.write_bytes(b"half")
    add_tiles(str(where), new_tiles([str(other_map)]))
    assert not left.exists()


def test_an_open_atlas_keeps_its_tiles(somewhere: str, room_map: Path, other_map: Path):
    create_atlas(somewhere, new_tiles([str(room_map)], "hall"))
    before = Atlas.open(somewhere)
    add_tiles(somewhere, new_tiles([str(other_map)], "hall"), replaces=True)
    assert before.map_path(before.tile("hall")).read_bytes() == room_map.read_bytes()
    after = Atlas.open(somewhere)
    assert after.map_path(after.tile("hall")).read_bytes() == other_map.read_bytes()


def test_unnamed_files_are_removed_after_their_time(
    room_map: Path, other_map: Path, tmp_path: Path
):
    where = tmp_path / "campus"
    create_atlas(str(where), new_tiles([str(room_map)], "hall"))

    def files():
        return {path.suffix for path in (where / "tiles").iterdir() if path.name.startswith("hall")}

    litter = where / "tiles" / "killed-0123.topo"
    litter.write_bytes(b"of a writer that was killed")
    remove_tiles(str(where), ["hall"])
    assert files() == {".topo", ".places"}
    add_tiles(str(where), new_tiles([str(other_map)]))
    assert files() == {".topo", ".places"}  # within their time
    assert litter.exists()
    long_ago = time.time() - 2 * editing.GRACE_S
    for path in (where / "tiles").iterdir():
        os.utime(path, (long_ago, long_ago))
    add_tiles(str(where), new_tiles([str(other_map)], "more"))
    assert files() == {".topo", ".places"}  # put long ago, but named until just now
    assert not litter.exists()
    add_tiles(str(where), new_tiles([str(other_map)], "even-more"), grace_s=0.0)
    assert files() == set()
    assert Atlas.open(str(where)).manifest.retired == {}
    assert _tiles(str(where)) == ["even-more", "more", "other"]


def test_a_tile_that_comes_back_is_not_swept(room_map: Path, tmp_path: Path):
    where = str(tmp_path / "campus")
    create_atlas(where, new_tiles([str(room_map)]))
    remove_tiles(where, ["room"])
    add_tiles(where, new_tiles([str(room_map)]))
    remove_tiles_again = add_tiles(where, new_tiles([str(room_map)], "twin"), grace_s=0.0)
    assert remove_tiles_again.retired == {}
    read = Atlas.open(where)
    assert [read.find_problem(tile.tile_id) for tile in read.manifest.tiles] == [None, None]


def test_two_writers_at_once_lose_nothing(
    somewhere: str, room_map: Path, monkeypatch: pytest.MonkeyPatch
):
    """Two writers begin together. The slow parts of a tile are replaced."""
    num_writes = NUM_WRITES[somewhere.partition("://")[0] if "://" in somewhere else "folder"]
    create_atlas(somewhere, new_tiles([str(room_map)]))
    ready = Atlas.open(somewhere).tile("room")

    def made(new: NewTile, store: Store) -> Tile:
        return structs.replace(ready, tile_id=new.tile_id, world=new.world)

    monkeypatch.setattr(editing, "store_tile", made)
    begin, failures = threading.Barrier(2), list[BaseException]()

    def write(writer: str) -> None:
        try:
            begin.wait()
            for number in range(num_writes):
                add_tiles(somewhere, new_tiles([str(room_map)], f"{writer}{number}"))
        except BaseException as error:
            failures.append(error)
            raise

    writers = [threading.Thread(target=write, args=(name,)) for name in "ab"]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    manifest = Atlas.open(somewhere).manifest
    assert not failures
    assert {tile.tile_id for tile in manifest.tiles} == {"room"} | {
        f"{name}{number}" for name in "ab" for number in range(num_writes)
    }
    assert manifest.serial == 1 + 2 * num_writes


def test_a_writer_that_comes_too_late_begins_anew(
    room_map: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Another writer commits between read and commit. Its tile stays, and a clash of
    ids is an error."""
    where = str(tmp_path / "campus")
    create_atlas(where, [])
    made: Callable[[NewTile, Store], Tile] = editing.store_tile

    def meanwhile(new: NewTile, store: Store) -> Tile:
        monkeypatch.setattr(editing, "store_tile", made)
        add_tiles(where, new_tiles([str(room_map)], "first"))
        return made(new, store)

    monkeypatch.setattr(editing, "store_tile", meanwhile)
    add_tiles(where, new_tiles([str(room_map)], "second"))
    assert _tiles(where) == ["first", "second"]
    remove_tiles(where, ["first"])
    monkeypatch.setattr(editing, "store_tile", meanwhile)
    with pytest.raises(AtlasError, match="has a tile first already"):
        add_tiles(where, new_tiles([str(room_map)], "first"))


def test_a_file_that_is_not_the_one_that_was_added_is_named(own_atlas: Path):
    read = Atlas.open(str(own_atlas))
    tile = read.tile("room")
    path = own_atlas / tile.map.name
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    assert "checksum" in str(read.find_problem(tile.tile_id))
    path.unlink()
    assert "missing" in str(read.find_problem(tile.tile_id))
    assert read.find_problem("other") is None


def test_invalid_atlases_and_tiles_are_refused(tmp_path: Path, room_map: Path):
    with pytest.raises(AtlasError, match="is no atlas"):
        Atlas.open(str(tmp_path))
    with pytest.raises(AtlasError, match="is no atlas"):
        add_tiles(str(tmp_path), new_tiles([str(room_map)]))
    with pytest.raises(AtlasError, match="no tile can be called"):
        new_tiles([str(room_map)], "../up")
    create_atlas(str(tmp_path / "campus"), [])
    with pytest.raises(AtlasError, match="has no tile 'room'"):
        remove_tiles(str(tmp_path / "campus"), ["room"])
    shutil.rmtree(tmp_path / "campus")
