from __future__ import annotations

import hashlib

import numpy as np
import pytest
from jaxtyping import Float64

from topoloc_worlds.conditions import CONDITIONS, Condition
from topoloc_worlds.corridor.lamps import ceiling_lamps
from topoloc_worlds.corridor.outdoors import outdoors
from topoloc_worlds.corridor.parts import Fittings
from topoloc_worlds.corridor.plan import EAST, HEIGHT, LENGTH, NORTH, SOUTH, WEST, WIDTH, walls_of
from topoloc_worlds.corridor.world import CAMERA_HEIGHT, LOOP, MOVABLE, build
from topoloc_worlds.scene import Scene, Surface

DAY, EVENING, NIGHT = (CONDITIONS[name] for name in ("day", "evening", "night"))


@pytest.fixture(scope="module")
def day() -> Scene:
    return build(0, DAY)


@pytest.fixture(scope="module")
def night() -> Scene:
    return build(0, NIGHT)


@pytest.fixture(scope="module")
def rearranged() -> Scene:
    return build(0, DAY, arrangement=1)


def digest(surfaces: list[Surface]) -> list[tuple[str, str]]:
    """Return name and hash of all data of each surface."""
    result = []
    for surface in surfaces:
        hasher = hashlib.sha256(
            surface.mesh.vertices.tobytes()
            + surface.mesh.faces.tobytes()
            + surface.mesh.uv.tobytes()
        )
        material = surface.material
        color = (
            material.color.tobytes()
            if isinstance(material.color, np.ndarray)
            else repr(material.color).encode()
        )
        hasher.update(color + repr((material.kind, material.roughness, material.radiance)).encode())
        result.append((surface.name, hasher.hexdigest()))
    return result


def fixed(scene: Scene) -> list[Surface]:
    return [surface for surface in scene.surfaces if not surface.name.startswith(MOVABLE)]


def movable(scene: Scene) -> list[Surface]:
    return [surface for surface in scene.surfaces if surface.name.startswith(MOVABLE)]


def triangles(surfaces: list[Surface]) -> Float64[np.ndarray, "n 3 3"]:
    return np.concatenate([surface.mesh.vertices[surface.mesh.faces] for surface in surfaces])


def test_same_arguments_same_bytes(day: Scene):
    assert digest(list(build(0, DAY).surfaces)) == digest(list(day.surfaces))


def test_another_seed_is_another_corridor():
    assert walls_of(0)["south outer"].openings != walls_of(1)["south outer"].openings
    here, there = (dict(digest(outdoors(seed, DAY))) for seed in (0, 1))
    for name in ("lawn", "crowns", "front 0"):
        assert here[name] != there[name], name


def test_arrangement_moves_only_movables(day: Scene, rearranged: Scene):
    assert digest(fixed(day)) == digest(fixed(rearranged))
    before, after = digest(movable(day)), digest(movable(rearranged))
    assert [name for name, _ in before] == [name for name, _ in after]
    moved = {name for (name, a), (_, b) in zip(before, after, strict=True) if a != b}
    for thing in ("chair cover", "carton", "leaves", "bin", "trolley frame", "door leaf"):
        assert MOVABLE + thing in moved, thing


def test_the_condition_changes_light_but_no_fixed_geometry(day: Scene, night: Scene):
    def shapes(scene: Scene) -> list[tuple[str, bytes]]:
        lights_only = ("window pane", "lit windows")
        return [
            (s.name, s.mesh.vertices.tobytes())
            for s in scene.surfaces
            if not s.name.startswith(lights_only)
        ]

    assert shapes(day) == shapes(night)


def lit(condition: Condition) -> set[int]:
    lamps = [
        surface
        for surface in ceiling_lamps(0, condition, Fittings.of(0))
        if surface.name == "lamp cover"
    ]
    return {number for number, lamp in enumerate(lamps) if lamp.material.kind == "light"}


def test_lamps_by_condition():
    assert len(lit(EVENING)) > len(lit(NIGHT)) > len(lit(DAY)) > 5
    assert len(lit(NIGHT) ^ lit(DAY)) >= 6, "the light comes from elsewhere by night"


def test_windows_are_panes_only_when_it_is_dark(day: Scene, night: Scene):
    assert not any(surface.material.kind == "glass" for surface in day.surfaces)
    assert sum(surface.material.kind == "glass" for surface in night.surfaces) == 2


def test_the_floor_mirrors(day: Scene):
    floors = [surface for surface in day.surfaces if surface.name.startswith("floor ")]
    assert len(floors) == 4
    for floor in floors:
        assert floor.material.kind == "polished"
        assert 0.02 <= floor.material.roughness <= 0.08


@pytest.mark.parametrize("arrangement", [0, 1])
def test_nothing_stands_in_the_way(day: Scene, rearranged: Scene, arrangement: int):
    scene = (day, rearranged)[arrangement]
    for surface in scene.surfaces:
        corners = surface.mesh.vertices[surface.mesh.faces]
        low, high = corners.min(axis=1), corners.max(axis=1)
        for start, end in zip(LOOP, (*LOOP[1:], LOOP[0]), strict=True):
            tube_low = np.array(
                [min(start[0], end[0]) - 0.4, min(start[1], end[1]) - 0.4, CAMERA_HEIGHT - 0.4]
            )
            tube_high = np.array(
                [max(start[0], end[0]) + 0.4, max(start[1], end[1]) + 0.4, CAMERA_HEIGHT + 0.4]
            )
            inside = np.all((low < tube_high) & (high > tube_low), axis=1)
            assert not inside.any(), (
                f"{surface.name} at {corners[inside].mean(axis=(0, 1)).round(2)}"
            )


def test_the_corridor_is_closed_and_of_the_paper_s_size(day: Scene):
    walls = triangles(
        [surface for surface in day.surfaces if surface.name.startswith("wall ")]
    ).reshape(-1, 3)
    assert walls.min(axis=0).round(6).tolist() == [0.0, 0.0, 0.0]
    assert walls.max(axis=0).round(6).tolist() == [LENGTH, WIDTH, HEIGHT]
    floor = triangles([surface for surface in day.surfaces if surface.name.startswith("floor ")])
    area = (
        0.5
        * np.linalg.norm(
            np.cross(floor[:, 1] - floor[:, 0], floor[:, 2] - floor[:, 0]), axis=1
        ).sum()
    )
    assert area == pytest.approx(LENGTH * WIDTH - (LENGTH - WEST - EAST) * (WIDTH - SOUTH - NORTH))
    length = sum(
        np.hypot(a[0] - b[0], a[1] - b[1]) for a, b in zip(LOOP, (*LOOP[1:], LOOP[0]), strict=True)
    )
    assert 70 < length < 85


def test_meshes_are_sound_and_the_world_is_small_enough(day: Scene):
    for surface in day.surfaces:
        mesh = surface.mesh
        assert np.isfinite(mesh.vertices).all(), surface.name
        assert np.isfinite(mesh.uv).all(), surface.name
        assert mesh.faces.min() >= 0, surface.name
        assert mesh.faces.max() < len(mesh.vertices), surface.name
    assert sum(len(surface.mesh.faces) for surface in day.surfaces) < 300_000
    pictures = {
        id(s.material): s.material.color
        for s in day.surfaces
        if isinstance(s.material.color, np.ndarray)
    }
    assert sum(picture.nbytes for picture in pictures.values()) < 200e6


def test_floor_walls_and_lamps_face_the_corridor(day: Scene):
    towards = {
        "floor south": (0, 0, 1),
        "ceiling": (0, 0, -1),
        "wall south outer": (0, 1, 0),
        "wall east inner": (1, 0, 0),
    }
    for name, direction in towards.items():
        corners = triangles([surface for surface in day.surfaces if surface.name == name])
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert np.all(normals @ np.array(direction) > 0), name
