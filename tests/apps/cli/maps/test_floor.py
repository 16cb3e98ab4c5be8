"""Test the floor estimate of a map in a tilted world: the floor below a table, or a refusal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hand_made import two_nodes
from topoloc.apps.cli.maps.floor import find_floor
from topoloc.errors import MapError
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.mapping.topomap import TopoMetricMap

TILTED = Rigid3(exp_so3(np.array([0.9, -0.4, 0.3])), np.array([3.0, -2.0, 0.5]))
"""The map's world from a world with z up and the floor at 0."""
LEVEL_FROM_CAM = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def area(rng: np.random.Generator, lower: tuple, upper: tuple, num: int, noise: float = 0.01):
    points = rng.uniform(lower, upper, (num, 3))
    return points + rng.normal(0.0, noise, points.shape)


def place(points: np.ndarray) -> TopoMetricMap:
    """Return a map of two nodes, 1.3 m above the floor, that see these points (metres, z up)."""
    world = TILTED.apply(points)
    poses = [
        TILTED @ Rigid3(exp_so3(np.array([0.0, 0.0, turn])) @ LEVEL_FROM_CAM, np.array([x, 0, 1.3]))
        for x, turn in ((0.0, 0.2), (1.0, -0.2))
    ]
    topomap = two_nodes()
    roots = np.tile(np.array([0.01, 0, 0.01, 0, 0, 0.01], np.float32), (len(points), 1))
    nodes = [
        replace(
            node,
            summary=replace(node.summary, world_from_cam=pose),
            points_cam=pose.inverse().apply(world).astype(np.float32),
            point_sqrt_covs=roots,
        )
        for node, pose in zip(topomap.nodes, poses, strict=True)
    ]
    layer = replace(topomap.first_layer, nodes=nodes)
    return replace(topomap, summaries=[one.summary for one in nodes], layers={"surf": layer})


def test_floor_below_a_table_and_above_mirror_images():
    rng = np.random.default_rng(1)
    floor = area(rng, (-2, 1, 0), (2, 5, 0), 300)
    table = area(rng, (0, 2, 0.74), (1.6, 2.9, 0.74), 900)
    shelves = area(rng, (-2, 5, 0), (2, 5.3, 1.2), 300)
    mirrored = area(rng, (-2, 1, -1.2), (2, 5, -0.2), 40)
    found = find_floor(place(np.concatenate([floor, table, shelves, mirrored])))
    up = TILTED.rotation[:, 2]
    assert np.degrees(np.arccos(min(1.0, found.up_world @ up))) < 0.3
    assert abs(found.offset - TILTED.translation @ up) < 0.01
    assert found.area_m2 > 8.0


@pytest.mark.parametrize("seen", ["table", "nothing"])
def test_surfaces_that_are_no_floor(seen: str):
    rng = np.random.default_rng(2)
    table = area(rng, (0, 2, 0.7), (1.6, 2.9, 0.7), 400)
    clutter = area(rng, (-2, 1, 0), (2, 5, 1.2), 1500)
    points = (
        np.concatenate([table, clutter])
        if seen == "table"
        else area(rng, (0, 2, 1.5), (2, 5, 2), 100)
    )
    with pytest.raises(MapError, match="no floor is seen"):
        find_floor(place(points))


def test_narrow_floor_leaves_the_tilt_open():
    rng = np.random.default_rng(3)
    strip = area(rng, (0.1, 0.6, 0), (0.2, 5.5, 0), 200)
    with pytest.raises(MapError, match="leaves its tilt open by"):
        find_floor(place(strip))


def test_an_exact_up_direction_needs_the_height_only():
    rng = np.random.default_rng(3)
    up = TILTED.rotation[:, 2]
    strip = area(rng, (0.1, 0.6, 0), (0.2, 5.5, 0), 200)
    found = find_floor(place(strip), up)
    assert np.array_equal(found.up_world, up)
    assert abs(found.offset - TILTED.translation @ up) < 0.01
