from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tiny_network import write_network
from topoloc.errors import FeatureTypeError
from topoloc.features.feature_types import (
    FEATURE_TYPES,
    FeatureConfig,
    FeatureType,
    find_feature_type,
)


@pytest.mark.parametrize("kind", FEATURE_TYPES.values(), ids=lambda kind: kind.name)
def test_the_declared_properties_of_a_type_are_right(
    kind: FeatureType, shared_picture: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    if kind.network is not None:  # of a network that stands for the real one
        monkeypatch.setenv("TOPOLOC_CACHE", str(tmp_path))
        write_network(
            tmp_path / f"{kind.network}.onnx", kind.network, descriptor_size=kind.descriptor_size
        )
    features = kind.extract(shared_picture, FeatureConfig(kind=kind.name, max_features=200), 1)
    assert 100 < len(features) <= 200
    assert features.descriptors.shape[1] == kind.descriptor_size
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1.0, atol=1e-3)
    # few values are clipped in a map file: the scale of the type suits its descriptors
    assert np.mean(np.abs(features.descriptors) * kind.descriptor_scale > 127) < 1e-3
    assert (np.ptp(features.sizes_px) > 0) == kind.has_scale
    assert (np.ptp(features.angles) > 0) == kind.has_angle


def test_an_unknown_type_is_an_error_that_lists_all_types():
    with pytest.raises(FeatureTypeError, match="'orb'; there are surf, sift"):
        find_feature_type("orb")


@pytest.fixture(scope="module")
def shared_picture() -> np.ndarray:
    """Return an image of blobs and edges of all sizes."""
    rng, picture = np.random.default_rng(0), np.full((240, 320), 128.0)
    for _ in range(400):
        x, y, half = rng.integers(0, 320), rng.integers(0, 240), int(2 + rng.exponential(6.0))
        picture[max(y - half, 0) : y + half, max(x - half, 0) : x + half] = rng.integers(0, 256)
    return picture.astype(np.uint8)
