"""Test the street: an equal town for an equal seed, a free road, and the size of the paper."""

from __future__ import annotations

import functools
from collections import defaultdict

import numpy as np
import pytest

import topoloc_worlds.street.world as street
from topoloc_worlds.conditions import find_condition
from topoloc_worlds.scene import Scene, Surface
from topoloc_worlds.street.fronts import fronts
from topoloc_worlds.street.furniture import furniture_materials
from topoloc_worlds.street.materials import street_materials
from topoloc_worlds.street.roads import LENGTH, centre_line, position
from topoloc_worlds.street.trees import leaves
from topoloc_worlds.street.vehicles import PAINTS, SHAPES, car, car_materials

GROUND = {"road", "puddle", "pavement", "kerb", "ground", "lawn"}


@functools.cache
def built(seed: int, condition: str, arrangement: int) -> Scene:
    return street.build(seed, find_condition(condition), arrangement)


def moves(surface: Surface) -> bool:
    return surface.name.startswith(("parked car", "bin"))


def geometry(scene: Scene) -> dict[str, list[bytes]]:
    """Return by name all vertices that no arrangement moves."""
    found = defaultdict(list)
    for surface in scene.surfaces:
        if not moves(surface):
            # Panes with light behind them are another surface than dark ones, so their corners are
            # compared as a set.
            found[surface.name] += [row.tobytes() for row in surface.mesh.vertices]
    return {name: sorted(rows) for name, rows in found.items()}


def outside_loop(points: np.ndarray) -> np.ndarray:
    """Return the signed distance of points (x, y) to the driven line: positive outside of a
    rectangle of 333 by 81 m with corners of 12 m radius."""
    beyond = np.abs(points) - (np.array([333.0, 81.0]) / 2 - 12.0)
    return (
        np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0) - 12.0
    )


def test_same_arguments_same_bytes() -> None:
    one, other = built(3, "day", 0), street.build(3, find_condition("day"), 0)
    assert len(one.surfaces) == len(other.surfaces)
    for a, b in zip(one.surfaces, other.surfaces, strict=True):
        assert a.name == b.name
        assert a.material.kind == b.material.kind
        assert np.asarray(a.material.color).tobytes() == np.asarray(b.material.color).tobytes()
        for field in ("vertices", "faces", "uv"):
            assert getattr(a.mesh, field).tobytes() == getattr(b.mesh, field).tobytes()


def test_another_seed_is_another_town() -> None:
    kit = street_materials(4, find_condition("day"))
    other = Scene(tuple(fronts(4, kit, furniture_materials(np.random.default_rng(0)))))
    assert geometry(built(3, "day", 0))["wall"] != geometry(other)["wall"]


def test_condition_and_arrangement_move_only_cars_and_bins() -> None:
    day, night = built(3, "day", 0), built(3, "night", 1)
    assert geometry(day) == geometry(night)
    cars = [
        np.concatenate([s.mesh.vertices for s in scene.surfaces if s.name == "parked car plates"])
        for scene in (day, night)
    ]
    assert cars[0].shape != cars[1].shape or not np.allclose(cars[0], cars[1])
    bins = [
        np.concatenate([s.mesh.vertices for s in scene.surfaces if s.name == "bin"])
        for scene in (day, night)
    ]
    assert bins[0].shape != bins[1].shape or not np.allclose(bins[0], bins[1])


@pytest.mark.parametrize("key", [(3, "day", 0), (3, "night", 1)])
def test_both_lanes_are_free(key: tuple[int, str, int]) -> None:
    np.testing.assert_allclose(outside_loop(np.array(street.LOOP)), 0.0, atol=1e-9)
    for surface in built(*key).surfaces:
        if surface.name in GROUND:
            continue
        corners = surface.mesh.vertices[surface.mesh.faces]
        low = corners[corners[:, :, 2].min(axis=1) < 2.5]
        # Middles of edges too: no triangle that low is so large that it could pass over a lane
        # between these points.
        points = np.concatenate(
            [low.reshape(-1, 3), (low + np.roll(low, 1, axis=1)).reshape(-1, 3) / 2]
        )[:, :2]
        right = outside_loop(points)
        for name, away in (("driven", right), ("other", right + street.OTHER_LANE_OFFSET)):
            assert not len(points) or np.abs(away).min() > 1.2, (
                f"{surface.name} at {points[np.abs(away).argmin()]} in the {name} lane"
            )


def test_loop_has_the_papers_size() -> None:
    corners = np.array(street.LOOP)
    np.testing.assert_allclose(np.ptp(corners, axis=0), [333.0, 81.0])
    around = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).sum()
    assert 780 < around < 820
    area = (
        np.sum(
            corners[:, 0] * np.roll(corners[:, 1], -1) - corners[:, 1] * np.roll(corners[:, 0], -1)
        )
        / 2
    )
    assert area > 0, "counter-clockwise"


def test_town_is_no_larger_than_it_may_be() -> None:
    for key in ((3, "day", 0), (3, "night", 1)):
        scene = built(*key)
        assert sum(len(surface.mesh.faces) for surface in scene.surfaces) < 600_000
        pictures = {
            id(s.material.color): s.material.color
            for s in scene.surfaces
            if isinstance(s.material.color, np.ndarray)
        }
        assert sum(picture.nbytes for picture in pictures.values()) < 250e6


def test_lamps_are_lit_by_night_only() -> None:
    def num_lit(scene: Scene) -> int:
        return sum(surface.material.kind == "light" for surface in scene.surfaces)

    assert num_lit(built(3, "day", 0)) == 0
    assert num_lit(built(3, "night", 1)) > 20


def test_stations_run_along_the_centre_line() -> None:
    stations = np.linspace(0.0, LENGTH, 4001)
    points, yaws = centre_line(stations)
    steps = np.diff(points, axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), LENGTH / 4000, rtol=1e-3)
    turned = np.column_stack([np.cos(yaws), np.sin(yaws)])[:-1]
    assert (np.sum(steps * turned, axis=1) > 0.99 * LENGTH / 4000).all()
    np.testing.assert_allclose(points[0], points[-1], atol=1e-9)
    x, y, yaw = position(100.0, 1.75)
    point, _ = centre_line(np.array([100.0]))
    np.testing.assert_allclose(
        [x - point[0, 0], y - point[0, 1]], [1.75 * np.sin(yaw), -1.75 * np.cos(yaw)], atol=1e-12
    )


@pytest.mark.parametrize("shape", SHAPES)
def test_cars_stand_on_their_wheels_and_keep_their_width(shape) -> None:
    kit = car_materials(np.random.default_rng(0))
    vertices = np.concatenate(
        [surface.mesh.vertices for surface in car(shape, len(PAINTS) - 1, 5, kit)]
    )
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    assert low[2] == pytest.approx(0.0, abs=0.01)
    assert high[0] - low[0] == pytest.approx(shape.length, abs=0.1)
    assert high[1] <= shape.width / 2 + 0.17  # the mirrors


def test_leaves_are_at_the_given_places() -> None:
    rng = np.random.default_rng(1)
    centres = rng.uniform(-2, 2, (50, 3))
    mesh = leaves(rng, centres)
    assert len(mesh.faces) == 100
    away = np.linalg.norm(mesh.vertices.reshape(50, 4, 3) - centres[:, None], axis=2)
    assert away.max() < 0.2
    assert away.min() > 0.02
