"""Test the matching that the pycolmap peer computes outside of pycolmap."""

from __future__ import annotations

import numpy as np

from topoloc_paper.colmap_worker import mutual_matches


def _unit(rows: np.ndarray) -> np.ndarray:
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def test_mutual_neighbours_are_found_in_any_order():
    rng = np.random.default_rng(0)
    train = _unit(rng.normal(size=(60, 128)))
    order = rng.permutation(60)[:40]
    query = _unit(train[order] + 0.01 * rng.normal(size=(40, 128)))
    query_idx, train_idx = mutual_matches(query, train, 0.8)
    assert np.array_equal(query_idx, np.arange(40))
    assert np.array_equal(train_idx, order)


def test_twins_and_too_few_descriptors_give_no_match():
    rng = np.random.default_rng(1)
    one = _unit(rng.normal(size=(1, 128)))
    twins = np.repeat(one, 2, axis=0)
    query = np.concatenate([one, _unit(rng.normal(size=(1, 128)))])
    assert len(mutual_matches(query, twins, 0.8)[0]) == 0
    assert len(mutual_matches(one, twins, 0.8)[0]) == 0
