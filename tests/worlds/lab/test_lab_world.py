"""Test the lab: equal arguments give an equal room, only movable objects move, and
the path is free."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

import topoloc_worlds.lab.world as lab
from topoloc_worlds.conditions import CONDITIONS
from topoloc_worlds.lab.shell import HEIGHT, LENGTH, REVEAL, WIDTH
from topoloc_worlds.scene import Scene, Surface

DAY, NIGHT = CONDITIONS["day"], CONDITIONS["night"]


@cache
def _day() -> Scene:
    return lab.build(3, DAY)


@cache
def _night() -> Scene:
    return lab.build(3, NIGHT)


@cache
def _rearranged() -> Scene:
    return lab.build(3, DAY, arrangement=1)


def _hash(surface: Surface) -> str:
    color = surface.material.color
    digest = hashlib.sha256(
        f"{surface.name} {surface.material.kind} {surface.material.radiance}".encode()
    )
    for array in (surface.mesh.vertices, surface.mesh.faces, surface.mesh.uv, np.asarray(color)):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _geometry(scene: Scene) -> list[tuple[str, bytes]]:
    return [(surface.name, surface.mesh.vertices.tobytes()) for surface in scene.surfaces]


def test_same_arguments_same_bytes_and_another_seed_is_another_room():
    again, other = lab.build(3, DAY), lab.build(4, DAY)
    hashes = [_hash(surface) for surface in _day().surfaces]
    assert [_hash(surface) for surface in again.surfaces] == hashes
    skies = [scene.sky for scene in (_day(), again)]
    assert skies[0] is not None
    assert skies[1] is not None
    np.testing.assert_array_equal(skies[0].radiance, skies[1].radiance)
    differing = {_hash(surface) for surface in other.surfaces} - set(hashes)
    assert len(differing) > len(hashes) // 2


def test_a_condition_changes_light_and_no_geometry():
    assert _geometry(_day()) == _geometry(_night())

    def shining(scene: Scene) -> set[str]:
        return {
            s.name
            for s in scene.surfaces
            if s.material.kind == "light" and s.material.radiance > 0.2
        }

    assert "outdoors" in shining(_day())
    assert "outdoors" not in shining(_night())
    assert {"bulb", "floor lamp bulb"} & shining(_night())
    assert not {"bulb", "floor lamp bulb"} & shining(_day())


def test_lamps_follow_the_condition():
    def share(scene: Scene) -> float:
        lamps = [s for s in scene.surfaces if s.name in ("ceiling lamp", "bulb", "floor lamp bulb")]
        return float(np.mean([s.material.kind == "light" for s in lamps]))

    assert share(lab.build(3, CONDITIONS["evening"])) == 1.0
    assert 0.0 < share(_night()) < NIGHT.lamps  # only such as people leave on
    assert share(_day()) == pytest.approx(DAY.lamps, abs=0.07)


def test_another_arrangement_moves_the_movable_only():
    before, after = _geometry(_day()), _geometry(_rearranged())
    fixed = [entry for entry in before if entry[0] not in lab.MOVABLE]
    assert fixed == [entry for entry in after if entry[0] not in lab.MOVABLE]
    moved = {name for name, _ in set(before) ^ set(after)}
    assert moved == lab.MOVABLE


def _near_the_walk(scene: Scene, clearance: float) -> set[str]:
    """Return the surfaces with a triangle whose bounding box is near the path, at camera height."""
    corners = np.array([*lab.LOOP, lab.LOOP[0]])
    names = set()
    for surface in scene.surfaces:
        triangles = surface.mesh.vertices[surface.mesh.faces]
        low, high = triangles.min(axis=1), triangles.max(axis=1)
        at_height = (low[:, 2] < lab.CAMERA_HEIGHT + clearance) & (
            high[:, 2] > lab.CAMERA_HEIGHT - clearance
        )
        for a, b in itertools.pairwise(corners):
            start, end = np.minimum(a, b) - clearance, np.maximum(a, b) + clearance
            meets = np.all((low[:, :2] < end) & (high[:, :2] > start), axis=1)
            if np.any(at_height & meets):
                names.add(surface.name)
    return names


@pytest.mark.parametrize("scene", [_day, _rearranged])
def test_the_walk_is_free(scene: Callable[[], Scene]):
    assert _near_the_walk(scene(), 0.3) == set()


def test_the_walk_is_a_loop_of_eight_metres():
    corners = np.array(lab.LOOP)
    assert 8.0 < np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).sum() < 9.0


def test_everything_is_in_the_room_and_sound():
    outside = {"outdoors"}
    for surface in _day().surfaces:
        mesh = surface.mesh
        assert np.isfinite(mesh.vertices).all()
        assert np.isfinite(mesh.uv).all()
        corners = mesh.vertices[mesh.faces]
        areas = np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        assert np.mean(areas > 0) >= 0.5, surface.name
        if surface.name not in outside:
            assert np.all(mesh.vertices > [-0.05, -0.05, -0.05]), surface.name
            assert np.all(mesh.vertices < [LENGTH + 0.05, WIDTH + REVEAL + 0.05, HEIGHT + 0.01]), (
                surface.name
            )


def test_the_room_is_light_enough_to_render():
    scene = _day()
    pictures = {
        id(s.material): s.material.color
        for s in scene.surfaces
        if not isinstance(s.material.color, tuple)
    }
    assert sum(picture.nbytes for picture in pictures.values()) < 150e6
    assert sum(len(s.mesh.faces) for s in scene.surfaces) < 200_000
