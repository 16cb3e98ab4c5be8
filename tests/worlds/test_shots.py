from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc_worlds.conditions import CONDITIONS
from topoloc_worlds.rendering.renderer import Renderer, Rendering
from topoloc_worlds.routes import RouteConfig, plan_route
from topoloc_worlds.sensor import SensorConfig
from topoloc_worlds.shots import Shooting, shoot

CAMERA = Camera.pinhole(96, 64, 60.0, 60.0, 47.5, 31.5)
QUIET = SensorConfig(full_well=1e12, read_noise=0.0, white_balance_error=0.0, vignetting=0.0)


class StripedWall(Renderer):
    """Render a wall 2 m in front of any camera, with upright stripes fixed to the world's y axis,
    without Mitsuba."""

    def __init__(self, brightness: float = 1.0) -> None:
        self.brightness = brightness
        self.seeds: list[int] = []

    def render(self, camera: Camera, world_from_cam: Rigid3, seed: int) -> Rendering:
        self.seeds.append(seed)
        x = (np.arange(camera.width) - camera.cx) / camera.fx * 2.0
        right = float(world_from_cam.translation @ world_from_cam.rotation[:, 0])
        stripes = (self.brightness * (0.5 + 0.4 * np.sin(4.0 * (x + right)))).astype(np.float32)
        light = np.repeat(np.repeat(stripes[None, :, None], camera.height, axis=0), 3, axis=2)
        return Rendering(light, np.full((camera.height, camera.width), 2.0, np.float32))


@pytest.fixture
def shooting() -> Shooting:
    route = plan_route(
        ((0.0, 0.0), (9.0, 0.0), (9.0, 5.0), (0.0, 5.0)),
        1.2,
        RouteConfig(start=4.0, wobble=0.0, look=np.pi / 2),
    )
    return Shooting(StripedWall(), CONDITIONS["day"], route, CAMERA, baseline=0.12, sensor=QUIET)


def test_the_right_picture_is_seen_from_a_baseline_further_right(shooting: Shooting):
    shot = shoot(shooting, 2)
    assert shot.right is not None
    offset = round(0.12 / 2.0 * 60.0 * 10) / 10
    assert offset == 3.6
    ahead = np.arange(10, 80)
    left, right = (picture[32, :, 1].astype(float) for picture in (shot.left, shot.right))
    np.testing.assert_allclose(
        np.interp(ahead + offset, np.arange(96), left), right[ahead], atol=1.5
    )
    assert shot.depth.max() == 2.0


def test_frames_are_the_same_in_any_order_and_no_two_share_their_noise(shooting: Shooting):
    noisy = replace(shooting, sensor=SensorConfig(white_balance_error=0.0, vignetting=0.0))
    later_first = [shoot(noisy, index) for index in (3, 2)]
    in_order = [shoot(noisy, index) for index in (2, 3)]
    assert np.array_equal(later_first[1].left, in_order[0].left)
    assert np.array_equal(later_first[0].left, in_order[1].left)
    assert isinstance(noisy.renderer, StripedWall)
    assert len(set(noisy.renderer.seeds)) == 4, "two frames of two pictures"
    assert in_order[0].right is not None
    noise = [picture.astype(int) - quiet for picture, quiet in zip(
        (in_order[0].left, in_order[0].right), (shoot(shooting, 2).left, shoot(shooting, 2).right), strict=True  # noqa: E501
    )]  # fmt: skip
    assert abs(np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1]) < 0.3


def test_motion_blurs_along_the_way_in_the_dark_only(shooting: Shooting):
    fast = replace(shooting, route=plan_route(((0.0, 0.0), (90.0, 0.0), (90.0, 50.0)), 1.2, RouteConfig(  # noqa: E501
        start=40.0, speed=12.0, spacing=1.0, wobble=0.0, look=np.pi / 2
    )), baseline=None)  # fmt: skip
    for brightness, least, most in ((1.0, 0.98, 1.01), (0.003, 0.5, 0.97)):
        sharp = shoot(replace(fast, renderer=StripedWall(brightness)), 1).left
        blurred = shoot(replace(fast, renderer=StripedWall(brightness), num_renderings=5), 1).left
        assert least < np.ptp(blurred[32, :, 1]) / np.ptp(sharp[32, :, 1]) < most


def test_rain_falls_only_where_there_is_no_roof(shooting: Shooting):
    rainy = replace(shooting, condition=CONDITIONS["rain"])
    assert np.array_equal(shoot(rainy, 1).left, shoot(shooting, 1).left)
    assert not np.array_equal(shoot(replace(rainy, rain=True), 1).left, shoot(shooting, 1).left)


def test_a_single_camera_has_no_right_picture_and_drops_stay_on_the_lens(shooting: Shooting):
    wet, dry = replace(shooting, baseline=None, lens_drops=5), replace(shooting, baseline=None)
    shots = [shoot(wet, index) for index in (1, 2)]
    assert shots[0].right is None
    wetted = [
        np.abs(shot.left.astype(int) - shoot(dry, index).left).max(axis=2) > 8
        for shot, index in zip(shots, (1, 2), strict=True)
    ]
    assert (wetted[0] & wetted[1]).sum() > 0.4 * (wetted[0] | wetted[1]).sum() > 0
