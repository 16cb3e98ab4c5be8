"""Test disparities of single points on textures given by formulas, with exact truth at any
fraction of a pixel."""

from __future__ import annotations

import numpy as np
import pytest

from topoloc.points.epipolar_kernels import match_in_ranges

WIDTH, HEIGHT = 320, 200


class Waves:
    """Define a texture at any coordinates: sixty waves of random direction, 6 to 40 pixels long."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        length, direction = (
            np.exp(rng.uniform(np.log(6), np.log(40), 60)),
            rng.uniform(0, np.pi, 60),
        )
        self.waves = np.stack(
            [np.cos(direction) / length, np.sin(direction) / length, rng.uniform(0, 2 * np.pi, 60)],
            axis=1,
        )

    def at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 128.0 + 7.0 * sum(
            np.sin(2 * np.pi * (u * x + v * y) + phase) for u, v, phase in self.waves
        )


def rendered_pair(
    offset: float, along: float, down: float, noise: float, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return left and right image of a plane of disparity offset + along * x + down * y (left
    pixels), in integer grey levels."""
    texture, rng = Waves(seed), np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(WIDTH, dtype=float), np.arange(HEIGHT, dtype=float))
    left, right = texture.at(x, y), texture.at((x + offset + down * y) / (1.0 - along), y)
    return tuple(
        np.clip(np.rint(p + rng.normal(0, noise, p.shape)), 0, 255).astype(np.float32)
        for p in (left, right)
    )  # pyright: ignore[reportReturnType]


def matched(
    left: np.ndarray, right: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    num = len(points)
    disparities, sigmas = np.empty(num, np.float32), np.empty(num, np.float32)
    match_in_ranges(
        left,
        right,
        points,
        np.zeros(num, np.int64),
        np.full(num, 81),
        5,
        0.8,
        0.97,
        disparities,
        sigmas,
    )
    return disparities, sigmas


def random_points(count: int, seed: int = 0) -> np.ndarray:
    return (
        np.random.default_rng(seed)
        .uniform((90, 10), (WIDTH - 10, HEIGHT - 10), (count, 2))
        .astype(np.float32)
    )


PLANES = [
    (12.0, 0.0, 0.0),
    (20.25, 0.0, 0.0),
    (7.5, 0.0, 0.0),
    (33.8, 0.0, 0.0),
    (10.1, 0.04, 0.0),
    (18.3, -0.05, 0.03),
    (25.0, 0.02, -0.06),
]


@pytest.mark.parametrize("plane", PLANES)
def test_disparity_is_unbiased_and_as_precise_as_its_sigma(plane: tuple[float, float, float]):
    left, right = rendered_pair(*plane, noise=2.0, seed=3)
    points = random_points(1500)
    disparities, sigmas = matched(left, right, points)
    found = np.isfinite(disparities)
    assert found.mean() > 0.9
    errors = (disparities - (plane[0] + plane[1] * points[:, 0] + plane[2] * points[:, 1]))[found]
    assert abs(np.median(errors)) < 0.01
    assert abs(errors.mean()) < 0.03
    assert (np.abs(errors) > 0.5).mean() < 0.005
    in_sigmas = 1.4826 * np.median(np.abs(errors / sigmas[found]))
    if plane[1:] == (0.0, 0.0):
        assert 0.5 < in_sigmas < 2.0
    # no window matches a slanted one exactly, and its residuals show this only in part: hence the
    # floor
    else:
        assert 1.4826 * np.median(np.abs(errors / np.hypot(sigmas[found], 0.12))) < 1.0


def test_no_fraction_of_a_pixel_is_preferred():
    """The error must not depend on the disparity's fraction, as the error of a parabola through
    correlations does."""
    errors = []
    for fraction in np.arange(0.0, 1.0, 0.125):
        points = random_points(400, 1)
        points[:, 0] = np.rint(points[:, 0])  # whole pixels, for the largest effect
        disparities, _ = matched(
            *rendered_pair(15.0 + fraction, 0.0, 0.0, noise=1.0, seed=5), points
        )
        errors.append(np.nanmedian(disparities) - 15.0 - fraction)
    assert np.abs(errors).max() < 0.03


def test_gain_and_offset_between_the_cameras_do_not_matter():
    left, right = rendered_pair(14.4, 0.0, 0.0, noise=0.0, seed=7)
    disparities, _ = matched(left, 0.6 * right + 40.0, random_points(300))
    assert np.nanmax(np.abs(disparities - 14.4)) < 0.1


def test_a_repeating_row_is_ambiguous_and_a_plain_wall_has_no_texture():
    x = np.broadcast_to(np.arange(WIDTH, dtype=np.float32), (HEIGHT, WIDTH))
    y = np.arange(HEIGHT, dtype=np.float32)[:, None]
    fence = (128 + 60 * np.sin(2 * np.pi * x / 16) + 20 * np.sin(y / 3)).astype(np.float32)
    assert np.isnan(matched(fence, fence, random_points(200))[0]).all()
    plain = np.full((HEIGHT, WIDTH), 90.0, np.float32)
    assert np.isnan(matched(plain, plain, random_points(200))[0]).all()


def test_a_point_that_the_right_camera_does_not_see_is_not_matched():
    left, right = rendered_pair(20.0, 0.0, 0.0, noise=1.0, seed=9)
    other, _ = rendered_pair(0.0, 0.0, 0.0, noise=1.0, seed=10)
    right[:, 100:200] = other[:, 100:200]
    points = random_points(600)
    disparities, _ = matched(left, right, points)
    hidden = (points[:, 0] > 126) & (points[:, 0] < 214)
    assert np.isfinite(disparities[hidden]).mean() < 0.06
    assert (
        np.isfinite(disparities[~hidden & ((points[:, 0] < 114) | (points[:, 0] > 226))]).mean()
        > 0.9
    )


def test_points_at_and_beyond_the_border_are_left_out():
    left, right = rendered_pair(20.0, 0.0, 0.0, noise=1.0, seed=11)
    points = np.array(
        [
            [2, 100],
            [WIDTH - 2, 100],
            [150, 2],
            [150, HEIGHT - 2],
            [-9, -9],
            [WIDTH + 9, HEIGHT + 9],
            [12, 100],
        ],
        np.float32,
    )
    assert np.isnan(matched(left, right, points)[0]).all()
    assert np.isnan(matched(left, right, np.zeros((0, 2), np.float32))[0]).all()
