from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from topoloc.errors import TopolocError
from topoloc.geometry.rigid import Rigid3
from topoloc_worlds.routes import (
    Route,
    RouteConfig,
    frame_poses,
    plan_route,
    velocity_at,
    world_from_cam_at,
)

RECTANGLE = ((0.0, 0.0), (10.0, 0.0), (10.0, 6.0), (0.0, 6.0))
ON_RAILS = RouteConfig(wobble=0.0)


def centres(route: Route) -> np.ndarray:
    return np.array([pose.translation for pose in frame_poses(route)])


def forward(pose: Rigid3) -> np.ndarray:
    return pose.rotation[:, 2]


def test_on_rails_the_camera_stays_on_the_line_and_looks_along_it():
    route = plan_route(RECTANGLE, 1.5, ON_RAILS)
    at = centres(route)
    assert np.all(at[:, 2] == 1.5)
    to_sides = np.min([at[:, 0], 10 - at[:, 0], at[:, 1], 6 - at[:, 1]], axis=0)
    assert np.abs(to_sides).max() < 0.5, "bends cut the corners by no more than their radius"
    middle = min(
        frame_poses(route),
        key=lambda pose: float(np.linalg.norm(pose.translation - [5.0, 0.0, 1.5])),
    )
    np.testing.assert_allclose(middle.rotation, [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-6)


def test_frames_are_spaced_and_timed():
    route = plan_route(RECTANGLE, 1.5, replace(ON_RAILS, spacing=0.25, speed=0.5))
    steps = np.linalg.norm(np.diff(centres(route), axis=0), axis=1)
    assert np.median(steps) == pytest.approx(0.25, rel=1e-3)
    assert steps.max() <= 0.2501
    assert np.diff(route.t_ns) == pytest.approx(500_000_000)
    assert steps.sum() == pytest.approx(route.length, rel=0.01)


def test_a_lap_ends_where_it_began():
    route = plan_route(RECTANGLE, 1.5, replace(ON_RAILS, laps=2.0))
    assert np.linalg.norm(centres(route)[-1] - centres(route)[0]) < ON_RAILS.spacing
    assert route.length == pytest.approx(2 * 30.5, abs=1.0)


def test_lateral_is_to_the_left_and_reverse_goes_the_other_way():
    # This loop goes round counter-clockwise, so that its inside is on the left.
    inside, outside = (
        centres(plan_route(RECTANGLE, 1.5, replace(ON_RAILS, lateral=side))) for side in (0.5, -0.5)
    )
    assert inside[:, 1].min() == pytest.approx(0.5, abs=1e-3)
    assert outside[:, 1].min() == pytest.approx(-0.5, abs=1e-3)
    backward = plan_route(RECTANGLE, 1.5, replace(ON_RAILS, reverse=True, lateral=-0.5))
    assert centres(backward)[:, 1].min() == pytest.approx(0.5, abs=1e-3)
    nearest = min(
        frame_poses(backward),
        key=lambda pose: float(np.linalg.norm(pose.translation - [5.0, 0.5, 1.5])),
    )
    assert forward(nearest)[0] == pytest.approx(-1.0)


def test_start_length_and_number_of_frames():
    route = plan_route(RECTANGLE, 1.5, replace(ON_RAILS, start=3.0, length=5.0))
    at = centres(route)
    np.testing.assert_allclose(at[0], [3.0, 0.0, 1.5], atol=0.4)
    assert route.length == pytest.approx(5.0, abs=0.11)
    assert plan_route(RECTANGLE, 1.5, replace(ON_RAILS, num_frames=7)).num_frames == 7


def test_look_turns_the_camera_to_the_left():
    ahead, left = (
        plan_route(RECTANGLE, 1.5, replace(ON_RAILS, start=5.0, look=look))
        for look in (0.0, np.pi / 2)
    )
    np.testing.assert_allclose(
        forward(frame_poses(left)[0]),
        np.cross([0, 0, 1], forward(frame_poses(ahead)[0])),
        atol=1e-9,
    )


@settings(max_examples=6, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    motion=st.sampled_from(["walk", "drive"]),
    shake=st.sampled_from([0.0, 1.0]),
)
def test_the_sway_is_smooth_and_of_human_size(seed: int, motion: str, shake: float):
    config = RouteConfig(seed=seed, motion=motion, shake=shake, laps=0.5)  # type: ignore[arg-type]
    route, rails = (
        plan_route(RECTANGLE, 1.5, config),
        plan_route(RECTANGLE, 1.5, replace(config, wobble=0.0, shake=0.0)),
    )
    times = np.arange(0.0, 5.0, 0.02)
    sway = [world_from_cam_at(rails, t).inverse() @ world_from_cam_at(route, t) for t in times]
    moved, turned = np.array([s.translation for s in sway]), np.array([s.angle() for s in sway])
    assert 0.01 < np.abs(moved).max() < 0.6
    assert np.radians(0.1) < turned.max() < np.radians(14.0)
    acceleration = np.diff(moved, n=2, axis=0) / 0.02**2
    assert np.abs(acceleration).max() < 20.0, (
        "a jump of a centimetre would be 25 m/s^2 at these steps, a kink more"
    )


def test_laps_and_takes_differ_but_one_take_is_one_walk():
    config = RouteConfig(laps=2.0)
    first, again, other = (
        centres(plan_route(RECTANGLE, 1.5, replace(config, seed=seed))) for seed in (0, 0, 1)
    )
    assert np.array_equal(first, again)
    assert np.abs(first - other).max() > 0.05
    lap = len(first) // 2
    assert np.abs(first[:lap] - first[lap : 2 * lap]).max() > 0.05
    longer = centres(plan_route(RECTANGLE, 1.5, replace(config, laps=3.0)))
    assert np.array_equal(longer[: len(first)], first), (
        "a longer recording begins as the shorter one"
    )


def test_velocity_is_the_way_over_the_time():
    route = plan_route(RECTANGLE, 1.5, replace(ON_RAILS, start=5.0, speed=2.0))
    np.testing.assert_allclose(velocity_at(route, 0.5), [2.0, 0.0, 0.0], atol=0.01)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"spacing": 0.0}, "spacing"),
        ({"speed": float("nan")}, "speed"),
        ({"laps": -1.0}, "laps"),
        ({"num_frames": 0}, "number of frames"),
        ({"wobble": -0.1}, "wobble"),
    ],
)
def test_impossible_settings_are_named(change: dict[str, float], says: str):
    with pytest.raises(TopolocError, match=says):
        replace(ON_RAILS, **change)  # type: ignore[arg-type]


def test_impossible_lines_are_named():
    with pytest.raises(TopolocError, match=r"3\.5 m beside the line"):
        plan_route(RECTANGLE, 1.5, replace(ON_RAILS, lateral=3.5))
    with pytest.raises(TopolocError, match="three corners"):
        plan_route(((0.0, 0.0), (1.0, 0.0)), 1.5, ON_RAILS)
    with pytest.raises(TopolocError, match="named twice"):
        plan_route(((0.0, 0.0), (0.0, 0.0), (1.0, 0.0), (1.0, 1.0)), 1.5, ON_RAILS)
