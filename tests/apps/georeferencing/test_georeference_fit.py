"""Test the georeference of a map: estimated if the points determine it, else
refused in one line."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st

from topoloc.apps.georeferencing.georeference_fit import (
    UpDirection,
    estimate_up_direction,
    fit_georeference,
    georeference_from_heading,
)
from topoloc.errors import GeoreferenceError
from topoloc.geometry.geodesy import GeoPoint, Georeference
from topoloc.geometry.rigid import Rigid3, exp_so3

ORIGIN = GeoPoint(48.2, 16.37, 170.0)
Z_UP = estimate_up_direction(
    [Rigid3(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]), np.zeros(3))]
)
WALK = np.array(
    [
        [0.0, 0, 0],
        [8, 0, 0.1],
        [16, 1, 0],
        [16, 9, 0.2],
        [10, 12, 0],
        [2, 12, 0.1],
        [0, 6, 0],
        [4, 4, 0.3],
    ]
)
TRUE = Georeference(
    ORIGIN, Rigid3(exp_so3(np.array([0.0, 0.0, 0.7])), np.array([20.0, -30.0, 2.0])), "truth"
)


def places_of(
    points_world: np.ndarray, noise: float = 0.0, true: Georeference = TRUE
) -> list[GeoPoint]:
    rng = np.random.default_rng(0)
    return [true.geopoint(point + rng.normal(size=3) * noise) for point in points_world]


def off(found: Georeference, true: Georeference = TRUE) -> tuple[float, float]:
    """Return the largest error of a point of the walk (metres) and the angle between the two
    worlds (degrees)."""
    away = max(
        float(np.linalg.norm(found.geopoint(point).ecef() - true.geopoint(point).ecef()))
        for point in WALK
    )
    first, second = found.geopose(Rigid3.identity()), true.geopose(Rigid3.identity())
    turned = Rigid3.from_quat_wxyz(first.quat_wxyz, np.zeros(3)).inverse() @ Rigid3.from_quat_wxyz(
        second.quat_wxyz, np.zeros(3)
    )
    return away, math.degrees(turned.angle())


def test_up_is_the_axis_that_the_cameras_have_up():
    assert Z_UP.axis == "z"
    assert (
        estimate_up_direction(
            [Rigid3.identity(), Rigid3(exp_so3(np.array([0.3, 0.0, 0.0])), np.zeros(3))]
        ).axis
        == "-y"
    )
    assert estimate_up_direction([Rigid3.identity()], "x").axis == "x"
    with pytest.raises(GeoreferenceError, match="up is one of"):
        estimate_up_direction([Rigid3.identity()], "w")


@given(heading=st.floats(0, 359), pitch=st.floats(-1.2, 1.2))
def test_the_first_image_has_the_given_heading(heading: float, pitch: float):
    world_from_cam = Rigid3(
        Z_UP_CAMERA @ exp_so3(np.array([pitch, 0.0, 0.0])), np.array([3.0, 4.0, 1.5])
    )
    found = georeference_from_heading(world_from_cam, ORIGIN, heading, Z_UP)
    difference = found.heading_deg(world_from_cam.rotation[:, 2]) - heading
    assert (difference + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1e-6)
    place = found.geopose(world_from_cam).position
    assert (place.lat, place.lon, place.h) == pytest.approx((ORIGIN.lat, ORIGIN.lon, ORIGIN.h))
    np.testing.assert_allclose(
        found.enu_from_world.rotation @ [0.0, 0.0, 1.0], [0.0, 0.0, 1.0], atol=1e-12
    )


Z_UP_CAMERA = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def test_a_camera_that_looks_down_has_no_heading():
    down = Rigid3(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    with pytest.raises(GeoreferenceError, match="looks up or down"):
        georeference_from_heading(down, ORIGIN, 0.0, Z_UP)


@given(angles=st.tuples(*[st.floats(-3, 3)] * 3))
def test_known_points_give_any_world_back(angles: tuple[float, float, float]):
    true = Georeference(
        ORIGIN, Rigid3(exp_so3(np.array(angles)), np.array([5.0, 6.0, 7.0])), "truth"
    )
    points = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [0.0, 8.0, 0.0], [3.0, 3.0, 4.0]])
    fit = fit_georeference(points, places_of(points, true=true), "points")
    away, degrees = off(fit.georeference, true)
    assert away < 1e-3
    assert degrees < 0.01
    assert fit.residuals_m.max() < 1e-4


def test_gnss_is_used_except_for_outliers():
    way = np.repeat(WALK, 5, axis=0) + np.linspace(0, 0.5, 40)[:, None]
    places = places_of(way, noise=0.3)
    for k in range(0, 40, 4):  # outliers, as beside a wall
        places[k] = TRUE.geopoint(way[k] + [15.0, 5.0, 8.0])
    fit = fit_georeference(way, places, "gnss", Z_UP)
    assert list(np.flatnonzero(~fit.is_inlier)) == list(range(0, 40, 4))
    away, degrees = off(fit.georeference)
    assert away < 0.5
    assert degrees < 2.0
    assert fit.georeference.rms_m == pytest.approx(0.3 * math.sqrt(3.0), rel=0.25)


def test_a_straight_walk_is_enough_only_with_a_known_up():
    line = np.column_stack([np.linspace(0, 60, 30), np.zeros(30), np.zeros(30)])
    fit = fit_georeference(line, places_of(line, noise=0.1), "gnss", Z_UP)
    assert off(fit.georeference)[1] < 3.0
    with pytest.raises(GeoreferenceError, match="leave the rotation open"):
        fit_georeference(line, places_of(line, noise=0.1), "points")
    with pytest.raises(GeoreferenceError, match="leave the rotation open"):
        fit_georeference(line[:3], places_of(line[:3]), "points")
    upright = line[:, [1, 2, 0]]
    with pytest.raises(GeoreferenceError, match="leave the rotation open"):
        fit_georeference(upright, places_of(upright, noise=0.1), "gnss", Z_UP)


def test_impossible_places_are_refused():
    with pytest.raises(GeoreferenceError, match="at least 3"):
        fit_georeference(WALK[:2], places_of(WALK[:2]), "points")
    with pytest.raises(GeoreferenceError, match="too close together"):
        fit_georeference(WALK * 0.02, places_of(WALK * 0.02, noise=2.0), "gnss", Z_UP)
    with pytest.raises(GeoreferenceError, match="as far apart as in the map"):
        fit_georeference(WALK, places_of(WALK * 3.0), "gnss", Z_UP)
    with pytest.raises(GeoreferenceError, match=r"not the map's places|too close together"):
        fit_georeference(WALK, places_of(WALK[[3, 1, 7, 0, 2, 5, 4, 6]]), "gnss", Z_UP)
    swapped = [GeoPoint(place.lon, place.lat, place.h) for place in places_of(WALK)]
    swapped[3] = GeoPoint(-80.0, 100.0, 0.0)
    with pytest.raises(GeoreferenceError, match="latitude first"):
        fit_georeference(WALK, swapped, "gnss", Z_UP)


def test_an_axis_that_is_only_about_up_gives_way_to_the_points():
    tilted = Georeference(ORIGIN, Rigid3(exp_so3(np.array([0.15, 0.0, 0.0])), np.zeros(3)), "truth")
    way = np.repeat(WALK, 10, axis=0)
    fit = fit_georeference(
        way, places_of(way, noise=0.05, true=tilted), "gnss", UpDirection("z", math.radians(10.0))
    )
    assert off(fit.georeference, tilted)[1] < 0.6
