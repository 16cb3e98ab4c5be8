"""Check that a changed or damaged file of an atlas affects one tile at most, and that
`--check` finds it."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from built_room import unseen_views
from tiny_world import CAMERA
from topoloc.apps.cli import main
from topoloc.atlas.atlas import Atlas
from topoloc.localization.localizer import Localizer
from topoloc.localization.tiles import atlas_tiles


def _change(where: Path, tile_id: str, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the entry of a tile in a manifest of an older topoloc, which has no digest."""
    path = where / "atlas.json"
    data = json.loads(path.read_text())
    change(next(tile for tile in data["tiles"] if tile["id"] == tile_id))
    data.pop("digest", None)
    path.write_text(json.dumps(data))


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda tile: tile.update(focal_px=2 * tile["focal_px"]), "focal_px"),
        (lambda tile: tile["box_world"][0].__setitem__(1, -50.0), "box_world"),
        (lambda tile: tile.update(sessions=["elsewhere"]), "sessions"),
        (lambda tile: tile.update(kinds=["surf", "sift"]), "kinds"),
        (lambda tile: tile.update(map_id="0" * 16), "map_id"),
    ],
)
def test_check_compares_the_manifest_with_the_maps(
    own_atlas: Path, capsys: pytest.CaptureFixture[str], change: Callable, named: str
):
    assert main(["atlas", "info", str(own_atlas), "--check"]) == 0
    _change(own_atlas, "other", change)
    capsys.readouterr()
    assert main(["atlas", "info", str(own_atlas), "--check"]) == 1
    printed = capsys.readouterr().err
    assert printed == f"error: tile other: atlas.json differs from its map: {named}\n"


def test_check_compares_places_on_earth(room_map: Path, other_map: Path, tmp_path: Path):
    """The check covers a tile with its own georeference. The other tile's place follows from it."""
    path = Path(shutil.copy(room_map, tmp_path / "room.topo"))
    assert main(["georeference", str(path), "--origin", "50.8,4.7,30,0"]) == 0
    where = tmp_path / "campus"
    Atlas.create(str(where), [str(path), str(other_map)], world="hall")
    atlas, tile_ids = Atlas.open(str(where)), ["room", "other"]
    assert all(atlas.tile(one).geo_box is not None for one in tile_ids)
    assert [atlas.find_problem(one) for one in tile_ids] == [None, None]
    _change(where, "room", lambda tile: tile["geo_box"].__setitem__(0, 50.7))
    assert Atlas.open(str(where)).find_problem("room") == "atlas.json differs from its map: geo_box"
    _change(where, "room", lambda tile: tile["georeference"]["origin"].update(lat=50.7))
    problem = Atlas.open(str(where)).find_problem("room")
    assert problem == "atlas.json differs from its map: georeference, geo_box"


def _problems(where: Path) -> list[str]:
    return list(Atlas.open(str(where)).index.problems.values())


def _places(where: Path) -> Path:
    return where / Atlas.open(str(where)).tile("other").places.name


@pytest.fixture
def own_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Set a cache of this test, without an index of other tests."""
    monkeypatch.setenv("TOPOLOC_CACHE", str(tmp_path / "cache"))


@pytest.mark.usefixtures("own_cache")
def test_damaged_global_descriptors_cost_one_warning(own_atlas: Path):
    path = _places(own_atlas)
    whole, said = path.read_bytes(), list[str]()
    for at in (whole.rindex(b"PK\x01\x02") + 6, 5, 200):
        data = bytearray(whole)
        data[at] ^= 149
        path.write_bytes(data)
        (problem,) = _problems(own_atlas)
        assert "its checksum is another" in problem
    localizer = Localizer(str(own_atlas), warn=said.append)
    result = localizer.localize(unseen_views()[0][0], CAMERA)
    assert result.localized
    assert result.provenance.tile == "room"
    assert said == [f"tile other is searched after all others: {problem}"]


@pytest.mark.usefixtures("own_cache")
@pytest.mark.parametrize("save", [np.savez_compressed, np.savez])
def test_more_rows_than_nodes_are_refused(own_atlas: Path, save: Callable[..., None]):
    """The manifest has the matching checksum."""
    path = _places(own_atlas)
    with np.load(path) as stored:
        rows = np.repeat(stored["surf"][:1], 1000, axis=0)
    with path.open("wb") as file:
        save(file, surf=rows)
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    _change(own_atlas, "other", lambda tile: tile["places"].update(sha256=sha256))
    (problem,) = _problems(own_atlas)
    assert "damaged" in problem


def test_a_tile_that_is_missing_for_a_moment_is_tried_again(
    own_atlas: Path, monkeypatch: pytest.MonkeyPatch
):
    now, said = [100.0], list[str]()
    monkeypatch.setattr(atlas_tiles.time, "monotonic", lambda: now[0])
    atlas = Atlas.open(str(own_atlas))
    path = own_atlas / atlas.tile("room").map.name
    away = path.with_suffix(".away")
    localizer = Localizer(atlas, warn=said.append)
    image = unseen_views()[0][0]
    os.rename(path, away)
    assert not localizer.localize(image, CAMERA).localized
    os.rename(away, path)
    assert not localizer.localize(image, CAMERA).localized
    assert list(localizer.problems) == ["room"]
    now[0] += 60.0
    result = localizer.localize(image, CAMERA)
    assert result.localized
    assert result.provenance.tile == "room"
    assert not localizer.problems
    assert len(said) == 1
