import dataclasses
import json

import cv2
import numpy as np
import pytest

from topoloc.features.extraction import (
    NORMALIZATIONS,
    FeatureConfig,
    extract_features,
    extract_from_normalized,
    normalize_image,
)
from topoloc.features.features import MatchingConfig
from topoloc.features.matching import match_features


def picture(seed: int = 0) -> np.ndarray:
    random = np.random.default_rng(seed)
    layers = [
        cv2.resize(random.random((240 // k, 320 // k)), (320, 240), interpolation=cv2.INTER_CUBIC)
        for k in (4, 8, 16)
    ]
    return np.clip(sum(layers) * 85, 0, 255).astype(np.uint8)


def darkened(image: np.ndarray, seed: int = 0) -> np.ndarray:
    """Return the image with a third of the light, falling to a tenth at the right, a gamma
    curve and noise."""
    light = image / 255 / 3 * np.linspace(1.0, 0.3, image.shape[1])
    noise = np.random.default_rng(seed).normal(0, 4, image.shape)
    return np.clip(np.rint(255 * light**0.6 + noise), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("kind", ["surf", "sift"])
@pytest.mark.parametrize("normalization", list(NORMALIZATIONS))
def test_every_feature_type_and_normalisation(kind, normalization):
    config = FeatureConfig(kind=kind, normalization=normalization, max_features=300)
    features = extract_features(picture(), config)
    assert 100 < len(features) <= 300
    assert features.descriptors.shape[1] == {"surf": 64, "sift": 128}[kind]
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1.0, atol=1e-3)
    assert np.all(np.diff(features.responses) <= 0)


def test_the_two_steps_are_the_whole_and_threads_do_not_matter():
    config = FeatureConfig()
    image = picture()
    whole = extract_features(image, config)
    stepwise = extract_from_normalized(
        normalize_image(image, config, num_threads=1), config, num_threads=1
    )
    for field in dataclasses.fields(whole):
        assert np.array_equal(getattr(whole, field.name), getattr(stepwise, field.name))


def test_none_leaves_the_picture_alone():
    image = picture()
    assert np.array_equal(normalize_image(image, FeatureConfig(normalization="none")), image)
    assert not np.array_equal(normalize_image(image, FeatureConfig(normalization="wide")), image)


def test_config_survives_the_map_file():
    config = FeatureConfig(kind="sift", normalization="paper", max_features=10)
    assert FeatureConfig(**json.loads(json.dumps(dataclasses.asdict(config)))) == config


@pytest.mark.parametrize(
    "image",
    [np.zeros((60, 80), np.uint8), np.full((9, 9), 50, np.uint8), np.full((1, 1), 50, np.uint8)],
)
@pytest.mark.parametrize("kind", ["surf", "sift"])
def test_pictures_without_anything_have_no_features(kind, image):
    assert len(extract_features(image, FeatureConfig(kind=kind))) == 0


def num_right(query: np.ndarray, train: np.ndarray, config: FeatureConfig) -> int:
    """Count the matches of two images of the same view that are within 3 pixels of
    the right place."""
    a, b = extract_features(query, config), extract_features(train, config)
    matches = match_features(a.descriptors, b.descriptors, MatchingConfig())
    off = a.points_img[matches.query_idx] - b.points_img[matches.train_idx]
    return int((np.linalg.norm(off, axis=1) < 3.0).sum())


def test_features_outlive_a_change_of_light():
    image = picture()
    assert num_right(darkened(image), image, FeatureConfig()) > 200


@pytest.mark.parametrize("number", [100, 360, 600])
def test_wide_normalisation_beats_the_papers_on_a_real_picture(shared, number):
    path = shared / "data/seven_scenes/kitchen/seq-01" / f"frame-{number:06d}.color.jpg"
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    dark = darkened(image)
    wide, paper = (
        num_right(dark, image, FeatureConfig(normalization=name)) for name in ("wide", "paper")
    )
    assert wide > 1.2 * paper
    assert wide > 100
