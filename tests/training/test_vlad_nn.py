"""Test the NetVLAD layer against its formula, and its initial vocabulary."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from topoloc_training.vlad_nn import SECOND_SHARE, NetVlad, learn_words


def unit(array: np.ndarray) -> np.ndarray:
    return (array / np.linalg.norm(array, axis=-1, keepdims=True)).astype(np.float32)


def by_the_formula(maps: np.ndarray, assignment: np.ndarray, centroids: np.ndarray) -> np.ndarray:
    """Compute Eq. 1 to 4 of the paper, feature by feature."""
    features = unit(maps.reshape(maps.shape[0], -1).T)
    sums = np.zeros(centroids.shape)
    for feature in features:
        powers = np.exp(assignment @ feature - np.max(assignment @ feature))
        for k, share in enumerate(powers / powers.sum()):
            sums[k] += share * (feature - centroids[k])
    sums /= np.linalg.norm(sums, axis=1, keepdims=True)
    return sums.ravel() / np.linalg.norm(sums)


def test_the_layer_is_the_papers_formula():
    rng = np.random.default_rng(0)
    layer = NetVlad(5, 8)
    with torch.no_grad():
        layer.conv.weight.copy_(torch.from_numpy(3 * rng.standard_normal((5, 8, 1, 1))))
        layer.centroids.copy_(torch.from_numpy(rng.standard_normal((5, 8))))
    maps = rng.standard_normal((2, 8, 4, 3)).astype(np.float32)
    found = layer(torch.from_numpy(maps)).detach().numpy()
    for one, vector in zip(maps, found, strict=True):
        expected = by_the_formula(
            one, layer.conv.weight.detach().numpy()[:, :, 0, 0], layer.centroids.detach().numpy()
        )
        np.testing.assert_allclose(vector, expected, atol=1e-5)


def test_second_words_get_a_hundredth_of_the_first_ones_share():
    rng = np.random.default_rng(1)
    features = unit(
        rng.standard_normal((6, 16)).repeat(100, axis=0) + 0.3 * rng.standard_normal((600, 16))
    )
    centroids, assignment = learn_words(features, 6, seed=0)
    assert tuple(centroids.shape) == (6, 16)
    scores = np.sort(features @ assignment.numpy()[:, :, 0, 0].T, axis=1)
    assert np.mean(scores[:, -1] - scores[:, -2]) == pytest.approx(-np.log(SECOND_SHARE), rel=1e-4)


def test_few_features_give_few_words():
    features = unit(np.random.default_rng(2).standard_normal((90, 4)))
    assert len(learn_words(features, 64, seed=0)[0]) == 2
    assert len(learn_words(features[:3], 64, seed=0)[0]) == 1
