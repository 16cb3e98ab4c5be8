from __future__ import annotations

import numpy as np

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc_worlds.weather import Drops, draw_lens_drops, draw_rain, falling_drops

CAMERA = Camera.pinhole(320, 200, 190.0, 190.0, 159.5, 99.5)
LEVEL = Rigid3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
RIGHT_FROM_LEFT = Rigid3(np.eye(3), np.array([-0.5, 0.0, 0.0]))
WALL = np.full((200, 320), 20.0, np.float32)


def street() -> np.ndarray:
    light = np.full((200, 320, 3), 0.05, np.float32)
    light[:90] = 1.0
    return light


def one_drop(x: float, y: float, z: float) -> Drops:
    return Drops(np.array([[x, y, z]]), np.array([[0.0, 7.0, 0.0]]), np.array([1.5e-3]))


def column_of(picture: np.ndarray) -> float:
    change = np.abs(picture - street()).sum(axis=(0, 2))
    return float(change @ np.arange(320) / change.sum())


def test_a_drop_is_at_the_right_pixels_of_both_cameras():
    drops = one_drop(0.1, 0.3, 2.0)
    left = draw_rain(street(), WALL, CAMERA, Rigid3.identity(), drops, 0.005)
    right = draw_rain(street(), WALL, CAMERA, RIGHT_FROM_LEFT, drops, 0.005)
    assert abs(column_of(left) - (159.5 + 190.0 * 0.1 / 2.0)) < 0.2
    assert abs(column_of(left) - column_of(right) - 190.0 * 0.5 / 2.0) < 0.2


def test_drops_are_brighter_than_the_road_and_hidden_by_nearer_objects():
    drops = one_drop(0.0, 0.4, 2.0)
    rainy = draw_rain(street(), WALL, CAMERA, Rigid3.identity(), drops, 0.005)
    assert rainy.max() <= 1.0
    assert (rainy - street()).max() > 0.02
    behind = draw_rain(street(), np.full_like(WALL, 1.0), CAMERA, Rigid3.identity(), drops, 0.005)
    assert np.array_equal(behind, street())
    before_sky = draw_rain(
        street(), np.full_like(WALL, np.nan), CAMERA, Rigid3.identity(), drops, 0.005
    )
    assert np.array_equal(before_sky, rainy)


def test_near_drops_are_thicker_and_longer_exposures_longer():
    def touched(drops: Drops, time: float, axis: int) -> int:
        change = np.abs(
            draw_rain(street(), WALL, CAMERA, Rigid3.identity(), drops, time) - street()
        ).sum(axis=2)
        return int(np.sum(np.any(change > 1e-3, axis=axis)))

    near, far = one_drop(0.0, 0.12, 0.6), one_drop(0.0, 1.2, 6.0)
    assert touched(near, 0.001, axis=0) > 1.5 * touched(far, 0.001, axis=0)
    assert touched(far, 0.01, axis=1) > touched(far, 0.001, axis=1)


def test_rain_falls_before_the_camera_and_comes_towards_a_moving_one():
    still, driving = (
        falling_drops(500, CAMERA, LEVEL, np.array([v, 0.0, 0.0]), np.random.default_rng(0))
        for v in (0.0, 10.0)
    )
    in_picture = CAMERA.img_from_cam(still.position)
    assert np.all((in_picture > -1) & (in_picture < [320, 200]))
    assert np.all(still.velocity[:, 1] > 4.0), "down is +y"
    np.testing.assert_allclose(still.velocity[:, 2] - driving.velocity[:, 2], 10.0)
    assert 0.4 <= still.position[:, 2].min() < 1.0
    assert still.position[:, 2].max() > 5.0


def test_drops_on_the_lens_are_few_soft_blots():
    rng = np.random.default_rng(0)
    detail = rng.uniform(size=(200, 320, 3)).astype(np.float32)
    wet = draw_lens_drops(detail, 4, np.random.default_rng(1))
    changed = np.abs(wet - detail).max(axis=2) > 0.1
    assert 0.001 < changed.mean() < 0.2
    assert np.array_equal(draw_lens_drops(detail, 0, np.random.default_rng(1)), detail)
