import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from topoloc.errors import CalibrationError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc_worlds.scene import Haze, Material, Scene, Sky, Surface
from topoloc_worlds.shapes import box, panel

pytest.importorskip("mitsuba", reason="rendering needs Mitsuba")
from topoloc_worlds.rendering.renderer import RenderConfig, Renderer  # after the check above

CAMERA = Camera.pinhole(64, 40, 40.0, 40.0, 33.3, 17.2)
NORTH = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # looks along +y, world z up
DRAFT = RenderConfig.draft()
WHITE = Material("light", (1.0, 1.0, 1.0), radiance=1.0)


def looking_north(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Rigid3:
    return Rigid3(NORTH, np.array([x, y, z]))


def grey_sky(value: float = 1.0) -> Sky:
    return Sky(np.full((16, 32, 3), value, np.float32))


def quarters() -> np.ndarray:
    """Return an image with another colour in each corner: red and green above, blue
    and white below."""
    picture = np.zeros((32, 32, 3), np.uint8)
    picture[:16, :16], picture[:16, 16:], picture[16:, :16], picture[16:, 16:] = (
        (255, 0, 0),
        (0, 255, 0),
        (0, 0, 255),
        (255, 255, 255),
    )
    return picture


def slanted_wall() -> Surface:
    """Return a wall through (0, 5, 0) that is nearer to the camera on the right."""
    return Surface(
        "wall", panel((-8, 9, 8), (16, -8, 0), (0, 0, -16)), Material("matt", (0.6, 0.6, 0.6))
    )


def test_a_picture_hangs_upright_and_not_mirrored():
    scene = Scene(
        (
            Surface(
                "poster",
                panel((-1, 2, 1), (2, 0, 0), (0, 0, -2)),
                Material("light", quarters(), radiance=2.0),
            ),
        )
    )
    seen = Renderer(scene, DRAFT).render(CAMERA, looking_north(), 0).radiance
    found = {
        corner: tuple(np.round(seen[y, x], 2).tolist())
        for corner, (x, y) in {"tl": (24, 8), "tr": (42, 8), "bl": (24, 26), "br": (42, 26)}.items()
    }
    assert found == {"tl": (2, 0, 0), "tr": (0, 2, 0), "bl": (0, 0, 2), "br": (2, 2, 2)}


@pytest.mark.parametrize(
    ("column", "forward"), [(0, (1, 0, 0)), (16, (0, 1, 0)), (32, (-1, 0, 0)), (48, (0, -1, 0))]
)
def test_the_sky_goes_round_from_east_to_north(column, forward):
    radiance = np.full((32, 64, 3), 0.1, np.float32)
    radiance[14:18, [column - 1, column, (column + 1) % 64]] = (5.0, 0.0, 0.0)
    right = np.cross(forward, [0, 0, 1])
    pose = Rigid3(np.column_stack([right, [0, 0, -1], forward]).astype(np.float64), np.zeros(3))
    seen = Renderer(Scene((), Sky(radiance)), DRAFT).render(CAMERA, pose, 0)
    assert seen.radiance[17, 33] == pytest.approx([5.0, 0.0, 0.0], abs=0.05)
    assert np.isnan(seen.depth).all()


def test_an_empty_scene_is_rendered_while_another_one_is_alive():
    other = Renderer(Scene((slanted_wall(),), grey_sky()), DRAFT)
    other.render(CAMERA, looking_north(), 0)
    seen = Renderer(Scene((), grey_sky(0.7)), DRAFT).render(CAMERA, looking_north(), 0).radiance
    np.testing.assert_allclose(seen, 0.7, rtol=1e-3)


def test_the_zenith_is_the_first_row():
    radiance = np.concatenate([np.full((8, 32, 3), 3.0), np.full((8, 32, 3), 0.5)]).astype(
        np.float32
    )
    seen = (
        Renderer(Scene((), Sky(radiance)), DRAFT)
        .render(CAMERA, looking_north(), 0)
        .radiance[:, :, 0]
    )
    assert seen[2].mean() == pytest.approx(3.0, rel=1e-3)
    assert seen[-2].mean() == pytest.approx(0.5, rel=1e-3)


def test_the_sun_throws_shadows_away_from_itself():
    floor = Surface("floor", box((-5, 0, -0.1), (5, 10, 0)), Material("matt", (0.5, 0.5, 0.5)))
    pole = Surface("pole", box((-0.3, 3, 0), (0.3, 7, 1)), Material("matt", (0.5, 0.5, 0.5)))
    sun = replace(
        grey_sky(0.1),
        sun_direction=np.array([-1.0, 0.0, 1.0]) / np.sqrt(2),
        sun_irradiance=(10.0, 10.0, 10.0),
    )
    seen = (
        Renderer(Scene((floor, pole), sun), replace(DRAFT, samples=16))
        .render(CAMERA, looking_north(z=1.5), 0)
        .radiance[:, :, 0]
    )
    west, east = (
        np.round(CAMERA.img_from_cam(np.array([[x, 1.5, 5.0]]))[0]).astype(int) for x in (-0.9, 0.9)
    )
    assert seen[west[1], west[0]] > 5 * seen[east[1], east[0]]


def test_principal_point_and_focal_length_are_exact():
    # The weight of a small lamp's light is its middle: exact to a fiftieth of a pixel.
    points = np.array([[-1.1, 0.3, 3.0], [0.7, -0.9, 3.0], [1.3, 0.65, 3.0]])
    lamps = [
        Surface("lamp", panel((x - 0.2, z, 0.2 - y), (0.4, 0, 0), (0, 0, -0.4)), WHITE)
        for x, y, z in points
    ]
    renderer = Renderer(Scene(tuple(lamps)), replace(DRAFT, albedo_samples=60))
    seen = renderer.render(CAMERA, looking_north(), 0).radiance[:, :, 0]
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    for expected in CAMERA.img_from_cam(points):
        near = (abs(x - expected[0]) < 6) & (abs(y - expected[1]) < 6)
        middle = (
            np.array([(x[near] * seen[near]).sum(), (y[near] * seen[near]).sum()])
            / seen[near].sum()
        )
        assert np.abs(middle - expected).max() < 0.02


def test_light_and_colours_have_the_same_pixels():
    """The path tracer and the colour rays use one camera: the border of a lit wall is at
    the right pixel."""
    wall = Surface(
        "wall", panel((-1.0, 4, 0.8), (2.2, 0, 0), (0, 0, -1.5)), Material("matt", (0.5, 0.5, 0.5))
    )
    raw = replace(DRAFT, samples=64, light_filter=replace(DRAFT.light_filter, levels=0))
    renderer = Renderer(Scene((wall,), grey_sky()), raw)
    first, second = renderer._trace(CAMERA, looking_north(), 0)
    seen = 0.5 * (first + second)[:, :, 0]
    corners = CAMERA.img_from_cam(np.array([[-1.0, -0.8, 4.0], [1.2, 0.7, 4.0]]))
    row, column = seen[15] / np.median(seen[15, 26:42]), seen[:, 33] / np.median(seen[12:22, 33])
    assert row.sum() == pytest.approx(corners[1, 0] - corners[0, 0], abs=0.15)
    assert (row * np.arange(64)).sum() / row.sum() == pytest.approx(corners[:, 0].mean(), abs=0.1)
    assert (column * np.arange(40)).sum() / column.sum() == pytest.approx(
        corners[:, 1].mean(), abs=0.1
    )


def test_depth_of_a_slanted_plane_is_exact():
    depth = (
        Renderer(Scene((slanted_wall(),), grey_sky()), DRAFT)
        .render(CAMERA, looking_north(), 0)
        .depth
    )
    x = np.arange(CAMERA.width)
    # On the wall y = 5 - x / 2, and x / y is known for every pixel.
    expected = 5.0 / (1.0 + 0.5 * (x - CAMERA.cx) / CAMERA.fx)
    assert np.abs(depth - expected).max() < 1e-4


def test_left_depth_projected_into_the_right_image_agrees():
    thing = Surface(
        "thing", box((-0.5, 2.5, -0.6), (0.4, 3.1, 0.4)), Material("matt", (0.2, 0.3, 0.6))
    )
    renderer = Renderer(Scene((slanted_wall(), thing), grey_sky()), DRAFT)
    left, right = (
        renderer.render(CAMERA, looking_north(), 0).depth,
        renderer.render(CAMERA, looking_north(x=0.12), 0).depth,
    )
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    in_right = x - CAMERA.fx * 0.12 / left
    column = np.round(in_right).astype(int)
    inside = (column >= 0) & (column < CAMERA.width)
    there = right[y[inside], column[inside]]
    back = column[inside] + CAMERA.fx * 0.12 / there + (in_right[inside] - column[inside])
    assert np.median(np.abs(back - x[inside])) < 0.1


def test_depth_goes_through_holes_and_stops_at_glass():
    holes = np.zeros((8, 8), np.uint8)
    holes[:, :4] = 255
    leaf = Surface(
        "leaf",
        panel((-3, 2, 3), (6, 0, 0), (0, 0, -6)),
        Material("matt", (0.1, 0.5, 0.1), opacity=holes),
    )
    seen = Renderer(Scene((leaf, slanted_wall()), grey_sky()), DRAFT).render(
        CAMERA, looking_north(), 0
    )
    assert np.allclose(seen.depth[:, 5:28], 2.0, atol=1e-4)
    assert (seen.depth[:, 40:] > 3.0).all()
    pane = Surface("pane", panel((-3, 2, 3), (6, 0, 0), (0, 0, -6)), Material("glass"))
    lamp = Surface("lamp", panel((-9, 4, 9), (18, 0, 0), (0, 0, -18)), WHITE)
    behind = Renderer(Scene((pane, lamp)), DRAFT).render(CAMERA, looking_north(), 0)
    assert np.allclose(behind.depth, 2.0, atol=1e-4)
    assert behind.radiance[17, 33, 0] == pytest.approx(0.92, abs=0.02)


def test_a_matt_wall_under_an_even_sky_is_as_bright_as_its_albedo():
    wall = Surface(
        "wall", panel((-99, 5, 99), (198, 0, 0), (0, 0, -198)), Material("matt", (0.5, 0.5, 0.5))
    )
    seen = (
        Renderer(Scene((wall,), grey_sky(2.0)), DRAFT).render(CAMERA, looking_north(), 0).radiance
    )
    assert seen.mean() == pytest.approx(2.0 * 0.214, rel=0.05)


def test_haze_takes_its_share_by_distance():
    lamp = Surface("lamp", panel((-50, 10, 50), (100, 0, 0), (0, 0, -100)), WHITE)
    seen = (
        Renderer(Scene((lamp,), None, Haze(10.0, (0.5, 0.5, 0.5))), DRAFT)
        .render(CAMERA, looking_north(), 0)
        .radiance
    )
    assert seen[17, 33, 0] == pytest.approx(np.exp(-1.0) + 0.5 * (1 - np.exp(-1.0)), abs=2e-3)


def test_cameras_that_cannot_be_rendered_are_refused():
    renderer = Renderer(Scene((), grey_sky()), DRAFT)
    for camera in (
        Camera("SIMPLE_RADIAL", 64, 40, (40.0, 32.0, 20.0, 0.1)),
        Camera.pinhole(64, 40, 40.0, 42.0, 32.0, 20.0),
    ):
        with pytest.raises(
            CalibrationError, match="only cameras without distortion and with square pixels"
        ):
            renderer.render(camera, looking_north(), 0)


_HASH = """
import hashlib, sys
import numpy as np
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc_worlds.rendering.renderer import RenderConfig, Renderer
from topoloc_worlds.scene import Material, Scene, Sky, Surface
from topoloc_worlds.shapes import box
north = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
room = Surface("room", box((-2, -1, -1), (2, 5, 2)), Material("polished", (0.6, 0.5, 0.4)))
lamp = Surface("lamp", box((-0.5, 1, 1.8), (0.5, 2, 1.9)), Material("light", (1.0, 1.0, 1.0), radiance=1.0))
renderer = Renderer(Scene((room, lamp), None), RenderConfig.draft())
for seed in (3, 4, 3):
    seen = renderer.render(Camera.pinhole(64, 40, 40.0, 40.0, 33.3, 17.2), Rigid3(north, np.zeros(3)), seed)
    print(hashlib.sha256(seen.radiance.tobytes() + seen.depth.tobytes()).hexdigest())
"""  # noqa: E501


def test_same_seed_same_bytes_in_two_processes():
    run = [
        subprocess.run(
            [sys.executable, "-c", _HASH],
            capture_output=True,
            text=True,
            check=True,
            env=dict(os.environ),
        )
        for _ in range(2)
    ]
    first, other, again = run[0].stdout.split()[-3:]
    assert first == again != other
    assert run[1].stdout.split()[-3:] == [first, other, again]
