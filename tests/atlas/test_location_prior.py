"""Check that a location prior excludes only tiles with a known place out of reach."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from built_room import unseen_views
from tiny_world import CAMERA
from topoloc.atlas.atlas import Atlas
from topoloc.atlas.location_prior import (
    GeoPositionPrior,
    WorldPositionPrior,
    distances_to_boxes,
    tiles_in_reach,
)
from topoloc.atlas.manifest import Manifest, PlacesFile, StoredFile, Tile
from topoloc.errors import AtlasError
from topoloc.geometry.geodesy import GeoPoint, Georeference
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization, NotLocalized


def _tile(name: str, origin: GeoPoint | None = None, world: str | None = None) -> Tile:
    """Return a tile with a box of 10 by 10 metres. If it is georeferenced, the box begins
    at its origin."""
    stored, box = (
        StoredFile(f"tiles/{name}.topo", "ab" * 32, 10),
        np.array([[0.0, 0.0, 0.0], [10.0, 10.0, 0.0]]),
    )
    known = None if origin is None else Georeference(origin, Rigid3.identity(), "origin")
    corners = [] if known is None else [known.geopoint(corner) for corner in box]
    geo_box = (corners[0].lat, corners[0].lon, corners[1].lat, corners[1].lon) if corners else None
    return Tile(
        name,
        stored,
        PlacesFile(stored.name, stored.sha256, 10, {}),
        "0" * 16,
        1,
        ("surf",),
        4,
        (),
        300.0,
        box,
        world or name,
        known,
        geo_box,
        None,
    )


def _manifest(*tiles: Tile) -> Manifest:
    return Manifest().with_tiles({tile.tile_id: tile for tile in tiles}, 0.0)


def test_distance_is_along_the_ground_to_the_box():
    boxes = _manifest(_tile("a", GeoPoint(50.0, 4.0, 0.0)), _tile("unknown")).geo_boxes
    west = GeoPoint.from_ecef(
        GeoPoint(50.0, 4.0, 0.0).ecef_from_enu().apply(np.array([-300.0, 5.0, 0.0]))
    )
    assert distances_to_boxes(GeoPositionPrior(west.lat, west.lon, 1.0), boxes) == pytest.approx(
        [300.0, 0.0], rel=0.005
    )
    inside = GeoPoint.from_ecef(
        GeoPoint(50.0, 4.0, 0.0).ecef_from_enu().apply(np.array([3.0, 5.0, 0.0]))
    )
    assert distances_to_boxes(
        GeoPositionPrior(inside.lat, inside.lon, 1.0), boxes
    ) == pytest.approx([0.0, 0.0])


def test_the_date_line_is_no_border():
    boxes = _manifest(_tile("fiji", GeoPoint(-17.0, 179.9999, 0.0))).geo_boxes
    assert distances_to_boxes(GeoPositionPrior(-17.0, -179.9999, 1.0), boxes)[0] < 30.0
    assert distances_to_boxes(GeoPositionPrior(-17.0, 0.0, 1.0), boxes)[0] > 1e7


def test_only_tiles_with_a_known_place_are_out_of_reach():
    manifest = _manifest(
        _tile("here", GeoPoint(50.0, 4.0, 0.0)),
        _tile("far", GeoPoint(50.1, 4.0, 0.0)),
        _tile("island"),
    )
    assert set(tiles_in_reach(manifest, GeoPositionPrior(50.0, 4.001, 200.0))) == {"here", "island"}
    assert set(
        tiles_in_reach(manifest, GeoPositionPrior(50.0, 4.001, 200.0), georeferenced_only=True)
    ) == {"here"}
    assert set(tiles_in_reach(manifest, GeoPositionPrior(50.0, 4.001, 20_000.0))) == {
        "here",
        "far",
        "island",
    }
    assert set(tiles_in_reach(manifest, None, georeferenced_only=True)) == {"here", "far"}


def test_a_pose_is_brought_into_the_worlds_of_the_tiles_in_reach():
    turned = Rigid3(exp_so3(np.array([0.0, 0.0, 1.0])), np.zeros(3))
    near, far = (Georeference(GeoPoint(lat, 4.0, 0.0), turned, "origin") for lat in (50.0, 50.1))
    beside = replace(_tile("beside", GeoPoint(50.0, 4.0, 0.0)), georeference=near)
    away = replace(_tile("away", GeoPoint(50.1, 4.0, 0.0)), georeference=far)
    manifest = _manifest(
        _tile("here", GeoPoint(50.0, 4.0, 0.0), "campus"), beside, away, _tile("island")
    )
    pose = Rigid3(np.eye(3), np.array([5.0, 2.0, 1.0]))
    reached = tiles_in_reach(manifest, WorldPositionPrior("campus", pose, 30.0))
    assert set(reached) == {"beside", "here"}
    assert reached["here"] is pose
    expected = turned.inverse() @ pose
    assert reached["beside"] is not None
    assert np.allclose(reached["beside"].matrix(), expected.matrix(), atol=1e-6)
    assert (
        tiles_in_reach(
            manifest,
            WorldPositionPrior("campus", Rigid3(np.eye(3), np.array([50.0, 0.0, 0.0])), 30.0),
        )
        == {}
    )


def test_an_invalid_place_is_refused():
    for text in ("50,4", "north", "50,4,-1", "50,4,nan", "91,4,10", "nan,4,10", "50,4,inf"):
        with pytest.raises(AtlasError):
            GeoPositionPrior.parse(text)
    assert GeoPositionPrior.parse("-33.9,151.2,200") == GeoPositionPrior(-33.9, 151.2, 200.0)
    with pytest.raises(AtlasError, match="has no world 'moon'"):
        tiles_in_reach(_manifest(_tile("a")), WorldPositionPrior("moon", Rigid3.identity(), 1.0))
    with pytest.raises(AtlasError, match="above 0"):
        WorldPositionPrior("a", Rigid3.identity(), 0.0)


def test_an_image_is_localized_only_in_tiles_in_reach(atlas: Path):
    localizer = Localizer(Atlas.open(str(atlas)))
    image, world_from_cam = unseen_views()[0]
    near = localizer.near(WorldPositionPrior("room", world_from_cam, 5.0)).localize(image, CAMERA)
    assert isinstance(near, Localization)
    assert near.provenance.tile == "room"
    elsewhere = localizer.near(WorldPositionPrior("other", world_from_cam, 5.0)).localize(
        image, CAMERA
    )
    assert isinstance(elsewhere, NotLocalized)
    assert elsewhere.provenance.tile == "other"
    away = Rigid3(np.eye(3), np.array([0.0, 0.0, 500.0]))
    nowhere = localizer.near(WorldPositionPrior("room", away, 5.0)).localize(image, CAMERA, t_ns=5)
    assert isinstance(nowhere, NotLocalized)
    assert (nowhere.reason, nowhere.provenance.t_ns) == ("not_in_map", 5)
    assert "no tile lies within 5 m of 0, 0, 500 in the world room" in nowhere.detail
    assert isinstance(
        localizer.localize(image, CAMERA), Localization
    )  # the original localizer still searches all tiles
