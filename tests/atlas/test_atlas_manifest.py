"""Check that `atlas.json` is read as it was written, and that a damaged file is
refused in one line."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from msgspec.structs import replace

from topoloc.atlas.manifest import Manifest, PlacesFile, StoredFile, Tile
from topoloc.errors import AtlasError
from topoloc.geometry.geodesy import GeoPoint, Georeference
from topoloc.geometry.rigid import Rigid3, exp_so3


def _tile(name: str, georeference: Georeference | None = None) -> Tile:
    stored = StoredFile(f"tiles/{name}-0123.topo", "ab" * 32, 10)
    box = np.array([[0.0, 1.0, 2.0], [3.0, 4.0, 5.5]])
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
        name,
        georeference,
        None,
        None,
    )


def test_a_written_manifest_is_read():
    turn = Rigid3(exp_so3(np.array([0.0, 0.0, 0.3])), np.array([5.0, 6.0, 7.0]))
    placed = _tile("b", Georeference(GeoPoint(50.0, 4.0, 30.0), turn, "origin"))
    written = Manifest().with_tiles(
        {"a": replace(_tile("a"), recipe="cd" * 32), "b": placed}, now=5.0
    )
    read = Manifest.from_bytes(written.to_bytes(), "here")
    rows, read_rows = ([tile.to_json() for tile in one.tiles] for one in (written, read))
    poses, read_poses = (
        [row.pop("atlas_from_world") for row in each] for each in (rows, read_rows)
    )
    assert read_rows == rows
    assert np.allclose(read_poses[1], poses[1], atol=1e-12)
    assert [tile.tile_id for tile in read.tiles] == ["a", "b"]
    assert [tile.recipe for tile in read.tiles] == ["cd" * 32, None]
    assert (read.serial, read.origin) == (1, GeoPoint(50.0, 4.0, 30.0))
    assert read.by_id["a"].atlas_from_world is None


def test_georeferenced_tiles_lie_in_one_world():
    """Two maps share a corner and have different geographic origins. The corner is one
    point of the atlas."""
    near, far = GeoPoint(50.0, 4.0, 30.0), GeoPoint(50.001, 4.001, 35.0)
    corner_ecef = GeoPoint(50.0005, 4.0002, 33.0).ecef()
    turns = [Rigid3(exp_so3(np.array([0.0, 0.0, angle])), np.zeros(3)) for angle in (0.4, 2.0)]
    tiles = {
        name: _tile(name, Georeference(at, turn, "origin"))
        for name, at, turn in zip("ab", (near, far), turns, strict=True)
    }
    manifest = Manifest().with_tiles(tiles, now=0.0)
    corners = []
    for tile in manifest.tiles:
        assert tile.georeference is not None
        assert tile.atlas_from_world is not None
        corner_world = (
            (tile.georeference.origin.ecef_from_enu() @ tile.georeference.enu_from_world)
            .inverse()
            .apply(corner_ecef)
        )
        corners.append(tile.atlas_from_world.apply(corner_world))
    assert np.allclose(corners[0], corners[1], atol=1e-6)
    assert np.allclose(corners[0], near.ecef_from_enu().inverse().apply(corner_ecef), atol=1e-6)


def test_files_that_are_no_longer_named_are_retired_until_they_are_named_again():
    one = Manifest().with_tiles({"a": _tile("a")}, now=1.0)
    none = one.with_tiles({}, now=2.0)
    assert none.retired == {"tiles/a-0123.topo": 2.0, "tiles/a-0123.places": 2.0}
    assert none.with_tiles({}, now=3.0).retired == none.retired
    assert none.with_tiles({"a": _tile("a")}, now=4.0).retired == {}


_WRONG: list[tuple[list[Any], Any]] = [
    (["format"], "another"),
    (["version"], 2),
    (["serial"], -1),
    (["tiles"], {}),
    (["tiles", 0, "id"], "../a"),
    (["tiles", 0, "map", "file"], "../../etc/passwd"),
    (["tiles", 0, "map", "file"], "tiles/../../x"),
    (["tiles", 0, "map", "sha256"], "12"),
    (["tiles", 0, "box_world"], [[0, 0, 0]]),
    (["tiles", 0, "focal_px"], 0.0),
    (["tiles", 0, "atlas_from_world"], [[1, 2]]),
    (["tiles", 0, "geo_box"], [1.0]),
    (["tiles", 0, "world"], None),
    (["retired"], {"../x": 1.0}),
]


@pytest.mark.parametrize(("keys", "value"), _WRONG)
def test_damage_is_refused_in_one_line(keys: list[Any], value: Any):
    data = json.loads(Manifest().with_tiles({"a": _tile("a")}, now=1.0).to_bytes())
    at = data
    for key in keys[:-1]:
        at = at[key]
    at[keys[-1]] = value
    with pytest.raises(
        AtlasError, match=r"^here is no manifest of an atlas, or a damaged one: .+$"
    ):
        Manifest.from_bytes(json.dumps(data).encode(), "here")


def test_two_tiles_of_one_id_are_refused():
    data = json.loads(Manifest().with_tiles({"a": _tile("a")}, now=1.0).to_bytes())
    data["tiles"] *= 2
    with pytest.raises(AtlasError, match="two of one id"):
        Manifest.from_bytes(json.dumps(data).encode(), "here")


_JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
)


@given(st.binary(max_size=200) | _JSON.map(lambda value: json.dumps(value).encode()))
def test_anything_else_is_refused(data: bytes):
    with pytest.raises(AtlasError):
        Manifest.from_bytes(data, "here")


@pytest.mark.parametrize(
    ("old", "new"), [('"serial": 1', '"serial": 7'), ('"num_nodes": ', '"num_nodes": 1')]
)
def test_a_changed_manifest_is_refused(old: str, new: str):
    data = Manifest().with_tiles({"a": _tile("a")}, now=1.0).to_bytes()
    changed = data.decode().replace(old, new, 1).encode()
    assert changed != data
    with pytest.raises(AtlasError, match=r"its digest is another\. Restore the file"):
        Manifest.from_bytes(changed, "here")
    older = json.loads(changed)
    del older["digest"]
    Manifest.from_bytes(json.dumps(older).encode(), "here")
