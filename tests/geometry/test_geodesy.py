"""Test WGS-84 against PROJ, and GeoPoses."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given, strategies as st
from jsonschema import Draft202012Validator, ValidationError
from pyproj import Transformer

from schemas import GEOPOSE, GEOPOSE_YPR, SCHEMA, check_geopose
from topoloc.errors import GeoreferenceError
from topoloc.geometry.geodesy import GeoPoint, GeoPose, Georeference
from topoloc.geometry.rigid import Rigid3, exp_so3

ECEF_FROM_GEODETIC = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
LATITUDES, LONGITUDES, HEIGHTS = st.floats(-90, 90), st.floats(-180, 180), st.floats(-5000, 50_000)


@given(lat=LATITUDES, lon=LONGITUDES, h=HEIGHTS)
def test_earth_centred_coordinates_are_those_of_proj(lat: float, lon: float, h: float):
    np.testing.assert_allclose(
        GeoPoint(lat, lon, h).ecef(), ECEF_FROM_GEODETIC.transform(lon, lat, h), atol=1e-6
    )


@given(lat=LATITUDES, lon=LONGITUDES, h=HEIGHTS)
def test_the_inverse_conversion_gives_the_input(lat: float, lon: float, h: float):
    point = GeoPoint(lat, lon, h)
    again = GeoPoint.from_ecef(point.ecef())
    np.testing.assert_allclose(again.ecef(), point.ecef(), atol=1e-6)
    assert again.lat == pytest.approx(lat, abs=1e-10)
    assert again.h == pytest.approx(h, abs=1e-6)


@given(
    lat=st.floats(-89, 89),
    lon=LONGITUDES,
    h=st.floats(-100, 1000),
    east=st.floats(-900, 900),
    north=st.floats(-900, 900),
)
def test_east_north_up_is_that_of_proj(lat: float, lon: float, h: float, east: float, north: float):
    pipeline = (
        "+proj=pipeline +step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84"
        f" +lat_0={lat!r} +lon_0={lon!r} +h_0={h!r}"
    )
    place = Georeference(GeoPoint(lat, lon, h), Rigid3.identity(), "test").geopoint(
        np.array([east, north, 12.5])
    )
    np.testing.assert_allclose(
        Transformer.from_pipeline(pipeline).transform(place.lon, place.lat, place.h),
        (east, north, 12.5),
        atol=1e-5,
    )


def test_axes_of_a_geopose():
    """In an east-north-up world, a camera that looks east is a body without rotation. A camera that
    looks north is rotated by 90 degrees about up."""
    world = Georeference(GeoPoint(0.0, 0.0, 0.0), Rigid3.identity(), "test")
    looks_east = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    np.testing.assert_allclose(
        world.geopose(Rigid3(looks_east, np.zeros(3))).quat_wxyz, [1, 0, 0, 0], atol=1e-12
    )
    looks_north = exp_so3(np.array([0.0, 0.0, math.pi / 2])) @ looks_east
    root = math.sqrt(0.5)
    np.testing.assert_allclose(
        world.geopose(Rigid3(looks_north, np.zeros(3))).quat_wxyz, [root, 0, 0, root], atol=1e-12
    )
    assert world.heading_deg(looks_north[:, 2]) == pytest.approx(0.0, abs=1e-9)
    assert world.heading_deg(looks_east[:, 2]) == pytest.approx(90.0)


def test_up_is_that_of_the_cameras_own_place():
    """100 km east of the origin, the local horizontal plane differs by 0.9 degrees."""
    world = Georeference(GeoPoint(0.0, 10.0, 0.0), Rigid3.identity(), "test")
    geopose = world.geopose(Rigid3(np.eye(3), np.array([1e5, 0.0, 0.0])))
    at_origin = world.geopose(Rigid3.identity())
    turned = Rigid3.from_quat_wxyz(
        geopose.quat_wxyz, np.zeros(3)
    ).inverse() @ Rigid3.from_quat_wxyz(at_origin.quat_wxyz, np.zeros(3))
    assert math.degrees(turned.angle()) == pytest.approx(0.898, abs=0.01)


def test_json_is_strict_and_comes_again():
    place = Georeference(
        GeoPoint(-33.9, 151.2, 40.0),
        Rigid3(exp_so3(np.array([0.1, 0.2, 0.3])), np.array([1.0, 2.0, 3.0])),
        "gnss",
        0.25,
    )
    again = Georeference.from_json(json.loads(json.dumps(place.to_json())))
    assert (again.origin, again.source, again.rms_m) == (place.origin, "gnss", 0.25)
    np.testing.assert_allclose(
        again.enu_from_world.matrix(), place.enu_from_world.matrix(), atol=1e-15
    )
    geopose = place.geopose(Rigid3.identity())
    assert {key: set(value) for key, value in geopose.to_json().items()} == {
        "position": {"lat", "lon", "h"},
        "quaternion": set("xyzw"),
    }
    assert GeoPose.from_json(geopose.to_json()).to_json() == geopose.to_json()


@given(lat=LATITUDES, lon=LONGITUDES, h=HEIGHTS, seed=st.integers(0, 2**32 - 1))
def test_every_geopose_keeps_the_rules_of_the_standard(lat: float, lon: float, h: float, seed: int):
    numbers = np.random.default_rng(seed)
    turned = Rigid3(exp_so3(numbers.uniform(-4, 4, 3)), numbers.uniform(-1e4, 1e4, 3))
    place = Georeference(GeoPoint(lat, lon, h), turned, "origin")
    check_geopose(json.loads(json.dumps(place.geopose(turned).to_json())))


_POSITION = {"lat": 48.2, "lon": 16.37, "h": 170.0}
_QUATERNION = {"x": 0.0, "y": 0.0, "z": 0.6, "w": 0.8}
_ANGLES = {"yaw": 5.5, "pitch": -0.2, "roll": 0.1}


@pytest.mark.parametrize(
    "wrong",
    [
        {"position": _POSITION},
        {"position": _POSITION, "quaternion": list(_QUATERNION.values())},
        {"position": _POSITION, "angles": _ANGLES},
        {"location": {"lat": 48.2, "lon": 16.37, "h": 170.0}, "quaternion": _QUATERNION},
        {"position": {"lat": 48.2, "lon": 16.37}, "quaternion": _QUATERNION},
        {"position": _POSITION | {"lat": 91.0}, "quaternion": _QUATERNION},
        {"position": _POSITION, "quaternion": _QUATERNION, "timestamp": 5},
    ],
    ids=str,
)
def test_the_rules_refuse_drafts_and_other_forms(wrong: dict[str, object]):
    check_geopose({"position": _POSITION, "quaternion": _QUATERNION})
    Draft202012Validator(GEOPOSE_YPR).validate({"position": _POSITION, "angles": _ANGLES})
    with pytest.raises(ValidationError):
        check_geopose(wrong)
    strict = {key: rule for key, rule in SCHEMA["$defs"]["geopose"].items() if key != "description"}
    assert strict == GEOPOSE, "the published schema of results has the same rules"


@pytest.mark.parametrize(
    ("lat", "lon", "h"),
    [(91.0, 0.0, 0.0), (0.0, 400.0, 0.0), (0.0, 0.0, 1e9), (math.nan, 0.0, 0.0)],
)
def test_no_place_on_earth(lat: float, lon: float, h: float):
    with pytest.raises(GeoreferenceError):
        GeoPoint(lat, lon, h)


@pytest.mark.parametrize("data", [None, {}, [], {"origin": 3}, {"position": {}, "quaternion": {}}])
def test_invalid_georeferences_are_refused(data: object):
    with pytest.raises(GeoreferenceError):
        Georeference.from_json(data)
    with pytest.raises(GeoreferenceError):
        GeoPose.from_json(data)
