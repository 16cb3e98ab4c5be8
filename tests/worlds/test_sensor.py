from __future__ import annotations

import numpy as np
import pytest

from topoloc_worlds.conditions import CONDITIONS
from topoloc_worlds.sensor import (
    Exposure,
    SensorConfig,
    choose_exposure,
    take_picture,
    white_balance_of,
)

CONFIG = SensorConfig(vignetting=0.0)
NEUTRAL = np.ones(3)


def evenly(radiance: float, shape: tuple[int, int] = (64, 96)) -> np.ndarray:
    return np.full((*shape, 3), radiance, np.float32)


def picture(
    light: np.ndarray,
    exposure: Exposure | None = None,
    config: SensorConfig = CONFIG,
    seed: int = 0,
) -> np.ndarray:
    return take_picture(
        light,
        exposure or choose_exposure(light, config),
        config,
        np.random.default_rng(seed),
        NEUTRAL,
    )


@pytest.mark.parametrize("radiance", [0.02, 0.3, 2.0])
def test_exposure_makes_any_daylight_mid_grey(radiance: float):
    taken = picture(evenly(radiance))
    assert 0.40 < taken.mean() / 255 < 0.48, "0.16 in sRGB is 0.44"


def test_in_the_dark_time_grows_first_then_gain_then_the_image_darkens():
    bright, dim, dark = (
        choose_exposure(evenly(radiance), CONFIG) for radiance in (1.0, 0.005, 1e-5)
    )
    assert bright.gain == 1.0
    assert bright.time < CONFIG.max_time
    assert dim.time == CONFIG.max_time
    assert 1.0 < dim.gain < CONFIG.max_gain
    assert dark == Exposure(CONFIG.max_time, CONFIG.max_gain)
    assert picture(evenly(1e-5)).mean() < 60


def test_noise_grows_in_the_dark():
    sizes = [picture(evenly(radiance)).std() for radiance in (1.0, 0.003, 0.0006)]
    assert sizes[0] * 1.5 < sizes[1]
    assert sizes[1] * 1.5 < sizes[2]


def test_noise_has_the_variance_of_electrons():
    exposure = Exposure(0.01, 8.0)
    level = 0.2
    light = evenly(level / (CONFIG.sensitivity * exposure.time * exposure.gain), (200, 200))
    encoded = picture(light, exposure) / 255.0
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    electrons = CONFIG.full_well / exposure.gain
    assert linear.mean() == pytest.approx(level, rel=0.01)
    assert linear.std() == pytest.approx(
        np.sqrt(level * electrons + CONFIG.read_noise**2) / electrons, rel=0.05
    )


def test_a_bright_window_saturates_and_the_room_stays_visible():
    light = evenly(0.01)
    light[10:50, 10:40] = 2.0
    taken = picture(light)
    assert np.all(taken[15:45, 15:35] == 255)
    assert taken[:, 60:].mean() > 40


def test_no_more_than_the_allowed_share_is_white():
    light = evenly(1e-4)
    light[:, 40:] = 1.0
    assert picture(light)[:, 40:].mean() < 254, (
        "over half of the picture, so that it must keep its detail"
    )


def test_corners_are_darker_and_more_light_is_never_darker():
    config = SensorConfig(vignetting=0.3, full_well=1e9, read_noise=0.0)
    flat = picture(evenly(0.3), config=config)
    assert int(flat[32, 48, 0]) - int(flat[0, 0, 0]) > 10
    ramp = np.repeat(np.linspace(0.0, 5.0, 400, dtype=np.float32)[None, :, None], 3, axis=2)
    values = picture(
        ramp,
        Exposure(1.0 / CONFIG.sensitivity, 1.0),
        SensorConfig(vignetting=0.0, full_well=1e9, read_noise=0.0),
    )[0, :, 0]
    assert np.all(np.diff(values.astype(int)) >= 0)
    assert values[0] == 0
    assert values[-1] == 255


def test_white_balance_is_slightly_off_and_of_the_recording():
    day, again, night = (
        white_balance_of(CONDITIONS[name], 3, SensorConfig()) for name in ("day", "day", "night")
    )
    assert np.array_equal(day, again)
    assert not np.array_equal(day, night)
    assert np.all(np.abs(np.log([day, night])) < 0.25)


def test_same_seed_same_bytes_other_seed_other_noise():
    light = evenly(0.01)
    assert np.array_equal(picture(light, seed=1), picture(light, seed=1))
    assert not np.array_equal(picture(light, seed=1), picture(light, seed=2))
