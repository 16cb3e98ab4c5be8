from __future__ import annotations

import numpy as np
import pytest
from jaxtyping import Float64

from topoloc_worlds.conditions import CONDITIONS
from topoloc_worlds.corridor.plan import HEIGHT
from topoloc_worlds.hospital.plan import BAY, LENGTH, WIDTH, WING, lamp_sites, walls_of
from topoloc_worlds.hospital.world import CAMERA_HEIGHT, LOOP, MOVABLE, build
from topoloc_worlds.scene import Scene, Surface

DAY, EVENING, NIGHT = (CONDITIONS[name] for name in ("day", "evening", "night"))
REPEATED = (
    "panels",
    "handrail",
    "handrail brackets",
    "skirting",
    "floor",
    "ceiling",
    "lamp cover",
    "lamp frame",
)


@pytest.fixture(scope="module")
def day() -> Scene:
    return build(0, DAY)


def named(scene: Scene, name: str) -> Surface:
    (surface,) = (surface for surface in scene.surfaces if surface.name == name)
    return surface


def shapes(scene: Scene, movable: bool) -> list[tuple[str, bytes]]:
    chosen = [s for s in scene.surfaces if s.name.startswith(MOVABLE) == movable]
    return [(s.name, s.mesh.vertices.tobytes() + s.mesh.uv.tobytes()) for s in chosen]


def colors(scene: Scene) -> list[tuple[str, bytes]]:
    pictures = [(s.name, s.material.color) for s in scene.surfaces]
    return [
        (name, color.tobytes() if isinstance(color, np.ndarray) else repr(color).encode())
        for name, color in pictures
    ]


def triangles(surface: Surface) -> Float64[np.ndarray, "n 3 3"]:
    return surface.mesh.vertices[surface.mesh.faces]


def test_same_arguments_same_bytes_another_seed_another_ward(day: Scene):
    again, other = build(0, DAY), build(1, DAY)
    assert shapes(again, movable=False) == shapes(day, movable=False)
    assert colors(again) == colors(day)
    assert [w.doors for w in walls_of(0).values()] != [w.doors for w in walls_of(1).values()]
    signs = {dict(colors(scene))["door sign"] for scene in (day, other)}
    assert len(signs) == 2


def test_a_panel_is_the_copy_of_the_next(day: Scene):
    """The texture restarts at each bay, and only the position differs."""
    assert isinstance(named(day, "panels").material.color, np.ndarray)
    mesh = named(day, "panels").mesh
    for quad in mesh.vertices.reshape(-1, 4, 3):
        long = np.ptp(quad[:, :2], axis=0).max()
        assert long == pytest.approx(BAY * round(long / BAY))
    repeats = mesh.uv.reshape(-1, 4, 2)
    widths = np.array(
        [np.ptp(quad[:, :2], axis=0).max() for quad in mesh.vertices.reshape(-1, 4, 3)]
    )
    np.testing.assert_allclose(repeats[:, :, 0].max(axis=1) * BAY, widths)


@pytest.mark.parametrize("name", ["handrail brackets", "lamp cover"])
def test_mounted_objects_have_the_period_of_the_panels(day: Scene, name: str):
    """Each vertex on the south wing's outer wall has a copy one bay further, except at doors
    and at the ends."""
    points = named(day, name).mesh.vertices
    points = points[points[:, 1] < 1.6]
    beyond = points + np.array([BAY, 0.0, 0.0])
    inside = (beyond[:, 0] < LENGTH - WING) & (points[:, 0] > WING)
    distances = np.linalg.norm(beyond[inside][:, None] - points[None], axis=2).min(axis=1)
    assert np.mean(distances < 1e-6) > 0.75


def test_doors_are_rare_irregular_and_each_has_its_own_sign(day: Scene):
    walls = walls_of(0)
    doors = [door for wall in walls.values() for door in wall.doors]
    panelled = sum(bays for wall in walls.values() for _, bays in wall.panelled())
    assert 6 <= len(doors) <= 14
    assert panelled + 2 * len(doors) == sum(wall.num_bays for wall in walls.values())
    assert panelled / len(doors) > 6
    signs = [surface.material.color for surface in day.surfaces if surface.name == "door sign"]
    assert (
        len({sign.tobytes() for sign in signs if isinstance(sign, np.ndarray)})
        == len(doors)
        == len(signs)
    )
    for seed in range(6):
        for wall in walls_of(seed).values():
            assert np.all(np.diff(wall.doors) >= 8), (
                "two doors of one wall are never near each other"
            )


def test_arrangement_moves_only_movables(day: Scene):
    moved = build(0, DAY, arrangement=1)
    assert shapes(moved, movable=False) == shapes(day, movable=False)
    assert shapes(moved, movable=True) != shapes(day, movable=True)


def test_the_condition_changes_light_and_nothing_else(day: Scene):
    evening, night = build(0, EVENING), build(0, NIGHT)
    for other in (evening, night):
        assert shapes(other, movable=False) == shapes(day, movable=False)
    by_day, by_night = (named(scene, "lamp cover").material for scene in (day, night))
    assert by_day.kind == by_night.kind == "light"
    assert 0.0 < by_night.radiance < 0.5 * by_day.radiance
    assert day.sky is not None
    assert evening.sky is not None
    assert day.sky.sun_direction is not None
    assert evening.sky.sun_direction is None


def test_all_lamps_are_alike_so_that_light_distinguishes_no_bays(day: Scene):
    assert len(lamp_sites()) == round((2 * (LENGTH - 2 * WING) + 2 * (WIDTH - 2 * WING)) / BAY) + 4
    assert sum(surface.material.kind == "light" for surface in day.surfaces) == 1


def test_the_passage_is_closed_and_nothing_stands_in_it(day: Scene):
    for scene in (day, build(0, DAY, arrangement=3)):
        for surface in scene.surfaces:
            low, high = triangles(surface).min(axis=1), triangles(surface).max(axis=1)
            for start, end in zip(LOOP, (*LOOP[1:], LOOP[0]), strict=True):
                tube_low = np.array(
                    [min(start[0], end[0]) - 0.4, min(start[1], end[1]) - 0.4, CAMERA_HEIGHT - 0.4]
                )
                tube_high = np.array(
                    [max(start[0], end[0]) + 0.4, max(start[1], end[1]) + 0.4, CAMERA_HEIGHT + 0.4]
                )
                assert not np.any(np.all((low < tube_high) & (high > tube_low), axis=1)), (
                    surface.name
                )
    walls = [
        s
        for s in day.surfaces
        if s.name in ("panels", "door wall", "square wall", "door leaf", "window frame")
    ]
    corners = np.concatenate([s.mesh.vertices for s in walls])
    np.testing.assert_allclose(np.ptp(corners, axis=0), [LENGTH, WIDTH, HEIGHT], atol=0.5)


def test_floor_ceiling_and_panels_face_the_passage(day: Scene):
    for name, axis, sign in (("floor", 2, 1.0), ("ceiling", 2, -1.0)):
        corners = triangles(named(day, name))
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert np.all(sign * normals[:, axis] > 0), name
    corners = triangles(named(day, "panels"))
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    south = corners[:, :, 1].max(axis=1) < 1e-9
    assert np.all(normals[south, 1] > 0)


def test_meshes_are_sound_and_the_world_is_small(day: Scene):
    for surface in day.surfaces:
        mesh = surface.mesh
        assert np.isfinite(mesh.vertices).all(), surface.name
        assert np.isfinite(mesh.uv).all(), surface.name
        assert mesh.faces.max() < len(mesh.vertices), surface.name
    assert sum(len(surface.mesh.faces) for surface in day.surfaces) < 20_000


def test_repeated_surfaces_are_one_material_each(day: Scene):
    for name in REPEATED:
        named(day, name)
