"""Test the search in global descriptors, and the nodes that it returns."""

from __future__ import annotations

import threading

import faiss
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from topoloc.retrieval.descriptor_index import (
    DescriptorIndex,
    learn_visual_words,
    single_faiss_thread,
)


def unit(array: np.ndarray) -> np.ndarray:
    return (array / np.linalg.norm(array, axis=-1, keepdims=True)).astype(np.float32)


@settings(deadline=None)  # the first call compiles
@given(st.integers(1, 60), st.integers(1, 12), st.integers(1, 70), st.integers(0, 2**32 - 1))
def test_ranking_is_that_of_each_nodes_best_image(
    num_images: int, num_nodes: int, num_candidates: int, seed: int
):
    rng = np.random.default_rng(seed)
    vectors, node_ids = (
        unit(rng.standard_normal((num_images, 16))),
        rng.integers(0, num_nodes, num_images),
    )
    query = unit(rng.standard_normal(16))
    ranking = DescriptorIndex(vectors, node_ids).rank_nodes(query, num_candidates)
    similarities = vectors.astype(np.float64) @ query
    best = {int(node): similarities[node_ids == node].max() for node in np.unique(node_ids)}
    assert len(ranking) == min(num_candidates, len(best))
    assert [score.score for score in ranking] == pytest.approx(
        sorted(best.values(), reverse=True)[: len(ranking)], abs=1e-5
    )
    assert [score.score for score in ranking] == pytest.approx(
        [best[score.row] for score in ranking], abs=1e-5
    )


def test_a_node_of_many_images_does_not_hide_the_others():
    vectors = unit(np.vstack([np.ones((500, 8)), np.eye(8)]))
    node_ids = np.concatenate([np.zeros(500, np.int64), np.arange(1, 9)])
    ranking = DescriptorIndex(vectors, node_ids).rank_nodes(unit(np.ones(8)), 5)
    assert [score.row for score in ranking] == [0, 1, 2, 3, 4]


def test_many_vectors_are_searched_by_cells_and_nearly_always_as_exactly():
    rng = np.random.default_rng(3)
    steps = rng.standard_normal((120, 24)).repeat(25, axis=0)
    vectors = unit(steps + 0.4 * rng.standard_normal((3000, 24)))
    node_ids = np.arange(3000) // 3
    exact, by_cells = (
        DescriptorIndex(vectors, node_ids),
        DescriptorIndex(vectors, node_ids, max_exact=100),
    )
    queries = unit(vectors[::20] + 0.05 * rng.standard_normal((150, 24)))
    pairs = [(exact.rank_nodes(query, 5), by_cells.rank_nodes(query, 5)) for query in queries]
    assert np.mean([a[0].row == b[0].row for a, b in pairs]) >= 0.98
    for a, b in pairs:
        assert len({score.row for score in b}) == len(b) == 5
        assert [score.score for score in b] == sorted((score.score for score in b), reverse=True)
        assert b[0].score <= a[0].score + 2e-3  # the cells keep half floats


def test_cells_look_further_where_one_node_has_most_images():
    vectors = unit(
        np.vstack(
            [
                np.ones((900, 8)) + 0.01 * np.random.default_rng(4).standard_normal((900, 8)),
                np.eye(8),
            ]
        )
    )
    node_ids = np.concatenate([np.zeros(900, np.int64), np.arange(1, 9)])
    ranking = DescriptorIndex(vectors, node_ids, max_exact=100).rank_nodes(unit(np.ones(8)), 3)
    assert len({score.row for score in ranking}) == 3


def test_words_are_the_centres_of_clusters():
    rng = np.random.default_rng(4)
    centres = unit(rng.standard_normal((12, 16)))
    descriptors = unit(np.repeat(centres, 250, axis=0) + 0.02 * rng.standard_normal((3000, 16)))
    words = learn_visual_words(descriptors, 48, seed=0)
    nearest = np.max(centres @ unit(words).T, axis=1)
    assert words.shape == (48, 16)
    assert nearest.min() > 0.99
    np.testing.assert_array_equal(words, learn_visual_words(descriptors, 48, seed=0))


def test_without_faiss_many_vectors_are_compared_exactly(monkeypatch: pytest.MonkeyPatch):
    vectors = unit(np.random.default_rng(3).standard_normal((300, 8)))
    monkeypatch.setattr("topoloc.retrieval.descriptor_index.find_spec", lambda _: None)
    index = DescriptorIndex(vectors, np.arange(300), max_exact=100)
    assert [index.rank_nodes(vector, 1)[0].row for vector in vectors] == list(range(300))


def test_each_python_thread_has_its_own_number_of_faiss_threads():
    """`single_faiss_thread` needs no lock, because the last thread to leave changes no other
    thread's number."""
    entered, left, seen = threading.Event(), threading.Event(), list[int]()
    before = faiss.omp_get_max_threads()

    def longer() -> None:
        faiss.omp_set_num_threads(before + 2)
        with single_faiss_thread():
            entered.set()
            left.wait(10)
        seen.append(faiss.omp_get_max_threads())

    thread = threading.Thread(target=longer)
    with single_faiss_thread():
        thread.start()
        assert entered.wait(10)
        assert faiss.omp_get_max_threads() == 1
    assert faiss.omp_get_max_threads() == before
    left.set()
    thread.join()
    assert seen == [before + 2]
    assert faiss.omp_get_max_threads() == before
