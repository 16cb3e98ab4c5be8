import numpy as np

from topoloc_worlds.rendering.light_filter import LightFilterConfig, filter_light

SIZE = (80, 120)


def flat_wall() -> tuple[np.ndarray, np.ndarray]:
    y, x = np.indices(SIZE).astype(np.float32)
    position = np.stack([(x - 60) / 100, (y - 40) / 100, np.ones_like(x)], axis=-1) * np.float32(
        3.0
    )
    normal = np.zeros((*SIZE, 3), np.float32)
    normal[..., 2] = -1.0
    return normal, position


def filtered(
    light: np.ndarray, albedo: np.ndarray, noise: float, normal=None, mirror=None
) -> np.ndarray:
    rng = np.random.default_rng(0)
    wall, position = flat_wall()
    grains = [
        np.exp(noise * rng.standard_normal((*SIZE, 1)) - noise**2 / 2).astype(np.float32)
        for _ in range(2)
    ]
    pictures = (light * albedo * grains[0], light * albedo * grains[1])
    mirror = np.zeros(SIZE, bool) if mirror is None else mirror
    return filter_light(
        pictures, albedo, wall if normal is None else normal, position, mirror, LightFilterConfig()
    )


def grey(value: float = 0.5) -> np.ndarray:
    return np.full((*SIZE, 3), value, np.float32)


def test_noise_on_an_evenly_lit_wall_goes():
    result = filtered(grey(1.0), grey(), 0.8)
    assert np.abs(result.mean() - 1.0) < 0.03
    assert result.std() < 0.04


def test_the_walls_own_picture_leaves_no_trace_in_the_light():
    albedo = grey(0.8)
    albedo[:, ::7] = 0.02
    result = filtered(grey(1.0), albedo, 0.5)
    assert np.abs(result[:, ::7].mean() - 1.0) < 0.05
    assert result.std() < 0.05


def test_the_border_of_a_shadow_stays_sharp():
    light = grey(1.0)
    light[:, 60:] = 0.1
    result = filtered(light, grey(), 0.1)[10:-10]
    assert result[:, 59].mean() > 0.9
    assert result[:, 60].mean() < 0.2


def test_light_does_not_cross_the_edge_between_two_walls():
    light, normal = grey(1.0), flat_wall()[0].copy()
    light[:, 60:], normal[:, 60:] = 0.7, (1.0, 0.0, 0.0)
    result = filtered(light, grey(), 0.8, normal)
    assert np.abs(result[:, 59].mean() - 1.0) < 0.1
    assert np.abs(result[:, 60].mean() - 0.7) < 0.1


def test_a_firefly_is_put_out():
    pictures = [grey(0.5), grey(0.5)]
    pictures[0][40, 60] = 500.0
    normal, position = flat_wall()
    result = filter_light(
        (pictures[0], pictures[1]),
        grey(),
        normal,
        position,
        np.zeros(SIZE, bool),
        LightFilterConfig(),
    )
    assert result[40, 60].max() < 4.0
    assert np.abs(np.median(result) - 1.0) < 1e-3


def test_sky_stays_as_it_is_and_mirrors_keep_more_detail():
    light = grey(1.0)
    light[:, ::16] = 1.5
    sky = filtered(light, grey(), 0.0, np.zeros((*SIZE, 3), np.float32))
    assert np.allclose(sky, light, atol=1e-5)
    noisy = [filtered(light, grey(), 0.6, mirror=np.full(SIZE, mirror)) for mirror in (False, True)]
    assert noisy[1].std() > 1.2 * noisy[0].std()
