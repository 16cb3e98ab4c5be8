"""Compare traced light with formulas, and images made from it with path-traced images."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc_worlds.scene import Material, Scene, Sky, Surface
from topoloc_worlds.shapes import box, panel

pytest.importorskip("mitsuba", reason="rendering needs Mitsuba")
from topoloc_worlds.rendering.light_bake import LightBakeConfig
from topoloc_worlds.rendering.light_filter import LightFilterConfig
from topoloc_worlds.rendering.renderer import RenderConfig, Renderer
from topoloc_worlds.rendering.variant import LLVM, use_best_variant

CAMERA = Camera.pinhole(64, 40, 40.0, 40.0, 31.5, 19.5)
NORTH = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
LOOKING_NORTH = Rigid3(NORTH, np.array([0.0, 0.0, 1.5]))
LOOKING_DOWN = Rigid3(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 1.5]))
EYES = np.array([[0.0, 0.0, 1.5], [0.3, 0.0, 1.5]])
CONFIG = RenderConfig(bake=LightBakeConfig(finest=0.1, angle=0.03, rays=4000, paths=16))
FLOOR = Surface(
    "floor", panel((-4, 4, 0), (8, 0, 0), (0, -8, 0)), Material("matt", (0.5, 0.5, 0.5))
)
GREY = 0.2140  # reflectance of 0.5 in sRGB


@pytest.fixture(autouse=True)
def vectorised(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    if use_best_variant() != LLVM:
        pytest.skip("light is traced beforehand with LLVM only")


def test_a_floor_below_an_even_sky_sends_back_its_share():
    scene = Scene((FLOOR,), Sky(np.ones((16, 32, 3), np.float32)))
    seen = Renderer(scene, CONFIG, EYES).render(CAMERA, LOOKING_DOWN, 0).radiance
    np.testing.assert_allclose(seen, GREY, rtol=0.06)


def test_a_lamp_shines_by_the_square_of_its_distance():
    lamp = Surface(
        "lamp",
        panel((-0.1, -0.1, 3.0), (0.2, 0, 0), (0, 0.2, 0)),
        Material("light", (1.0, 1.0, 1.0), radiance=100.0),
    )
    seen = Renderer(Scene((FLOOR, lamp)), CONFIG, EYES).render(CAMERA, LOOKING_DOWN, 0).radiance
    below = GREY * 100.0 * 0.2**2 / (np.pi * 3.0**2)
    np.testing.assert_allclose(seen[20, 32], below, rtol=0.06)


def test_the_sun_has_sharp_shadows_and_no_noise():
    sun = Sky(np.zeros((16, 32, 3), np.float32), np.array([0.0, 0.6, 0.8]), (10.0, 10.0, 10.0))
    pole = Surface(
        "pole", box((0.4, -0.1, 0.0), (0.6, 0.1, 0.5)), Material("matt", (0.0, 0.0, 0.0))
    )
    seen = (
        Renderer(Scene((FLOOR, pole), sun), CONFIG, EYES)
        .render(CAMERA, LOOKING_DOWN, 0)
        .radiance[:, :, 0]
    )
    np.testing.assert_allclose(seen[:, :20], GREY * 10.0 * 0.8 / np.pi, rtol=0.01)
    shadow = seen[26, 44:47]  # south of the pole
    assert shadow.max() < 0.1 * seen[0, 0]


def test_a_polished_floor_mirrors_the_lamp_beyond():
    floor = replace(FLOOR, material=Material("polished", (0.2, 0.2, 0.2), roughness=0.0))
    lamp = Surface(
        "lamp",
        panel((-0.5, 3.9, 1.0), (1, 0, 0), (0, 0, -0.6)),
        Material("light", (1.0, 1.0, 1.0), radiance=5.0),
    )
    low = Rigid3(NORTH, np.array([0.0, 0.0, 0.8]))
    seen = Renderer(Scene((floor, lamp)), CONFIG, EYES).render(CAMERA, low, 0).radiance[:, :, 1]
    in_mirror = CAMERA.img_from_cam(np.array([[0.0, 0.8 + 0.7, 3.9]]))[0].round().astype(int)
    assert seen[in_mirror[1], in_mirror[0]] > 5 * np.median(seen[in_mirror[1], :8])


def test_pictures_agree_with_those_of_paths_of_their_own():
    white, red = Material("matt", (0.8, 0.8, 0.8)), Material("matt", (0.7, 0.2, 0.1))
    room = (
        Surface("room", box((-2, -1, 0), (2, 3, 2.5), faces="nsetb"), white),
        Surface("wall", box((-2, -1, 0), (2, 3, 2.5), faces="w"), red),
        Surface(
            "lamp",
            panel((-0.5, 0.5, 2.45), (1, 0, 0), (0, 1, 0)),
            Material("light", (1.0, 1.0, 1.0), radiance=3.0),
        ),
    )
    plain = RenderConfig(
        samples=512, bounces=4, light_filter=LightFilterConfig(levels=0, firefly=1e9)
    )
    reference = Renderer(Scene(room), plain).render(CAMERA, LOOKING_NORTH, 0).radiance
    baked = Renderer(Scene(room), CONFIG, EYES).render(CAMERA, LOOKING_NORTH, 0).radiance
    np.testing.assert_allclose(baked.mean(axis=(0, 1)), reference.mean(axis=(0, 1)), rtol=0.06)
    assert np.median(np.abs(baked / np.maximum(reference, 1e-3) - 1.0)) < 0.06


def test_light_is_read_from_the_cache_and_traced_again_if_that_is_broken(tmp_path: Path):
    scene = Scene((FLOOR,), Sky(np.ones((16, 32, 3), np.float32)))
    stages: list[int] = []

    def look() -> bytes:
        stages.clear()
        renderer = Renderer(scene, CONFIG, EYES, lambda stage, done, total: stages.append(done))
        return renderer.render(CAMERA, LOOKING_DOWN, 0).radiance.tobytes()

    first = look()
    assert stages == [1, 2]
    assert look() == first
    assert stages == []
    (kept,) = (tmp_path / "topoloc" / "light").iterdir()
    kept.write_bytes(kept.read_bytes()[:100])
    assert look() == first
    assert stages == [1, 2]
    kept.unlink()
    kept.parent.rmdir()
    kept.parent.write_text("a file where the folder should be")
    assert look() == first
