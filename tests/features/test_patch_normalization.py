import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from topoloc.features.extraction import PatchNormalizationConfig, patch_normalize


def picture(seed: int, height: int, width: int, contrast: float = 255.0) -> np.ndarray:
    coarse = np.random.default_rng(seed).random((height // 4 + 1, width // 4 + 1))
    return (np.kron(coarse, np.ones((4, 4)))[:height, :width] * contrast).astype(np.uint8)


def naive(image: np.ndarray, config: PatchNormalizationConfig) -> np.ndarray:
    """Compute the paper's equation directly, with window weights from its boxes,
    and do not round."""
    first, second = (np.ones(side) for side in config.box_sizes())
    profile = np.convolve(first, second)
    weights = np.outer(profile, profile) / profile.sum() ** 2
    padded = np.pad(image.astype(np.float64), config.window_px // 2, mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, weights.shape)
    mean = (windows * weights).sum((2, 3))
    sigma = np.sqrt(((windows - mean[..., None, None]) ** 2 * weights).sum((2, 3)))
    return np.clip(128.0 + config.gain * (image - mean) / (sigma + config.epsilon), 0.0, 255.0)


@settings(max_examples=25, deadline=None)
@given(
    st.integers(0, 1000),
    st.integers(20, 60),
    st.integers(20, 60),
    st.sampled_from(["square", "round"]),
    st.sampled_from([5, 7, 17, 19]),
    st.sampled_from([1e-3, 5.0]),
)
def test_is_the_equation_rounded(seed, height, width, shape, window_px, epsilon):
    config = PatchNormalizationConfig(window_px=window_px, epsilon=epsilon, shape=shape)
    image = picture(seed, height, width)
    assert np.abs(patch_normalize(image, config) - naive(image, config)).max() <= 0.5 + 1e-3


def test_the_papers_own_form():
    config = PatchNormalizationConfig.paper()
    image = picture(3, 70, 90)
    assert config.box_sizes() == (17, 1)
    assert config.epsilon < 0.01
    assert np.abs(patch_normalize(image, config) - naive(image, config)).max() <= 0.5 + 1e-3


@pytest.mark.parametrize(("shape", "window_px"), [("square", 127), ("round", 37)])
def test_extreme_contrast_in_the_widest_window(shape, window_px):
    image = np.kron(np.indices((6, 6)).sum(0) % 2, np.ones((5, 5))).astype(np.uint8) * 255
    config = PatchNormalizationConfig(window_px, shape=shape)
    for extreme in (image, np.full_like(image, 255)):
        assert np.abs(patch_normalize(extreme, config) - naive(extreme, config)).max() <= 0.5 + 1e-3


@pytest.mark.parametrize("shape", ["square", "round"])
def test_same_bytes_for_any_number_of_threads(shape):
    image = picture(5, 61, 47)
    config = PatchNormalizationConfig(shape=shape, epsilon=2.0)
    alone = patch_normalize(image, config, num_threads=1)
    for num_threads in (2, 3, 7, 100):
        assert np.array_equal(alone, patch_normalize(image, config, num_threads=num_threads))


def test_gain_and_offset_of_the_light_do_not_matter():
    image = picture(7, 60, 80, contrast=120.0)
    config = PatchNormalizationConfig.paper()
    assert (
        np.abs(
            patch_normalize(image, config).astype(int) - patch_normalize(image * 2 + 10, config)
        ).max()
        <= 1
    )


def test_plain_picture_is_grey():
    for config in (PatchNormalizationConfig.paper(), PatchNormalizationConfig(epsilon=0.0)):
        assert np.all(patch_normalize(np.full((20, 30), 77, np.uint8), config) == 128)


def test_noise_floor_keeps_plain_surfaces_calm():
    noise = np.random.default_rng(0).normal(100, 1.5, (60, 60)).round().astype(np.uint8)
    wild, calm = (
        patch_normalize(noise, PatchNormalizationConfig(epsilon=epsilon)).std()
        for epsilon in (1e-3, 8.0)
    )
    assert wild > 35
    assert calm < 8


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (5, 3)])
def test_pictures_smaller_than_the_window(shape):
    image = np.arange(np.prod(shape), dtype=np.uint8).reshape(shape)
    assert patch_normalize(image, PatchNormalizationConfig()).shape == shape


@pytest.mark.parametrize(
    "arguments",
    [
        {"window_px": 16},
        {"window_px": 1},
        {"window_px": 129},
        {"window_px": 39, "shape": "round"},
        {"epsilon": -1.0},
        {"gain": 0.0},
    ],
)
def test_config_refuses_nonsense(arguments):
    with pytest.raises(ValueError, match="must"):
        PatchNormalizationConfig(**arguments)
