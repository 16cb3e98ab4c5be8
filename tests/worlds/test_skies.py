from __future__ import annotations

import numpy as np
import pytest
from jaxtyping import Float64

from topoloc_worlds.conditions import CONDITIONS
from topoloc_worlds.scene import Sky
from topoloc_worlds.skies import sky_of


def directions(sky: Sky) -> Float64[np.ndarray, "h w 3"]:
    """Compute the directions from the description of `Sky.radiance`, independently of its code."""
    height, width, _ = sky.radiance.shape
    polar, azimuth = np.meshgrid(
        (np.arange(height) + 0.5) / height * np.pi,
        np.arange(width) / width * 2 * np.pi,
        indexing="ij",
    )
    return np.stack(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1
    )


def brightness(sky: Sky) -> float:
    z = directions(sky)[..., 2]
    weight = np.sqrt(1.0 - z**2) * (z > 0)
    return float((sky.radiance.mean(axis=-1) * weight).sum() / weight.sum())


def test_mean_radiance_is_the_daylight():
    for name, condition in CONDITIONS.items():
        if condition.daylight > 0:
            assert brightness(sky_of(condition, 3)) == pytest.approx(
                condition.daylight, rel=1e-3
            ), name


def test_brightness_in_order():
    levels = [
        brightness(sky_of(CONDITIONS[name], 0))
        for name in ("day", "cloudy", "rain", "evening", "night")
    ]
    assert levels == sorted(levels, reverse=True)
    assert 0.0 < levels[-1] < 1e-3


@pytest.mark.parametrize("seed", range(4))
def test_the_sky_is_brightest_near_the_sun(seed: int):
    sky = sky_of(CONDITIONS["day"], seed)
    assert sky.sun_direction is not None
    assert np.linalg.norm(sky.sun_direction) == pytest.approx(1.0)
    assert sky.sun_direction[2] > 0.5
    row, column = np.unravel_index(int(sky.radiance.mean(axis=-1).argmax()), sky.radiance.shape[:2])
    assert float(directions(sky)[row, column] @ sky.sun_direction) > np.cos(np.radians(8.0))


def test_the_sun_shines_by_day_only_and_always_from_the_same_point():
    for name, condition in CONDITIONS.items():
        sky = sky_of(condition, 5)
        assert (sky.sun_direction is not None) == condition.sun, name
        assert (max(sky.sun_irradiance) > 0) == condition.sun, name
    again = sky_of(CONDITIONS["day"], 5).sun_direction
    assert np.array_equal(again, sky_of(CONDITIONS["day"], 5).sun_direction)  # type: ignore[arg-type]
    assert not np.allclose(again, sky_of(CONDITIONS["day"], 6).sun_direction)  # type: ignore[arg-type]


def test_dusk_glows_where_the_sun_went_down():
    toward_sun = sky_of(CONDITIONS["day"], 1).sun_direction
    assert toward_sun is not None
    sky = sky_of(CONDITIONS["evening"], 1)
    row = sky.radiance.shape[0] // 2 - 3
    reddest = int((sky.radiance[row, :, 0] / sky.radiance[row, :, 2]).argmax())
    assert float(directions(sky)[row, reddest, :2] @ toward_sun[:2]) > 0.9 * float(
        np.linalg.norm(toward_sun[:2])
    )


def test_colours_of_the_sky():
    row = 20
    day, cloudy = (
        sky_of(CONDITIONS[name], 2).radiance[row].mean(axis=0) for name in ("day", "cloudy")
    )
    assert day[2] > 1.5 * day[0]
    assert cloudy[2] < 1.2 * cloudy[0]


def test_same_seed_same_bytes_and_no_seam():
    for condition in CONDITIONS.values():
        sky = sky_of(condition, 7)
        assert sky.radiance.tobytes() == sky_of(condition, 7).radiance.tobytes()
        inner = np.abs(np.diff(sky.radiance, axis=1)).max(axis=(0, 1))
        seam = np.abs(sky.radiance[:, 0] - sky.radiance[:, -1]).max(axis=0)
        assert np.all(seam <= inner)
        assert np.all(sky.radiance > 0)
    cloudy = CONDITIONS["cloudy"]
    assert not np.array_equal(sky_of(cloudy, 7).radiance, sky_of(cloudy, 8).radiance)
