import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from topoloc.features.features import MatchingConfig
from topoloc.features.matching import (
    TILE,
    Matcher,
    find_similar_pairs,
    match_features,
    match_pooled,
)


def unit(rows: np.ndarray) -> np.ndarray:
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def random_descriptors(seed: int, num: int, size: int = 64) -> np.ndarray:
    return unit(np.random.default_rng(seed).normal(size=(num, size)))


def blurred(descriptors: np.ndarray, seed: int, noise: float = 0.05) -> np.ndarray:
    return unit(descriptors + noise * np.random.default_rng(seed).normal(size=descriptors.shape))


def naive(query: np.ndarray, train: np.ndarray, ratio: float, mutual: bool) -> dict[int, int]:
    distances = np.linalg.norm(query[:, None].astype(np.float64) - train[None], axis=2)
    found = {}
    for row, of_row in enumerate(distances):
        first, *rest = np.argsort(of_row)
        if rest and not of_row[first] < ratio * of_row[rest[0]]:
            continue
        if not mutual or distances[:, first].argmin() == row:
            found[row] = int(first)
    return found


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 10_000),
    st.integers(1, 60),
    st.integers(1, 90),
    st.sampled_from([3, 8, 64]),
    st.sampled_from([0.7, 0.8, 0.95]),
    st.booleans(),
)
def test_exact_is_the_textbook(seed, num_query, num_train, size, ratio, mutual):
    query, train = (
        random_descriptors(seed, num_query, size),
        random_descriptors(seed + 1, num_train, size),
    )
    half = min(num_query, num_train) // 2
    query[:half] = blurred(train[:half], seed + 2)
    matches = match_features(query, train, MatchingConfig(ratio=ratio, mutual=mutual))
    assert dict(zip(matches.query_idx.tolist(), matches.train_idx.tolist(), strict=True)) == naive(
        query, train, ratio, mutual
    )
    exact = np.linalg.norm(query[matches.query_idx] - train[matches.train_idx], axis=1)
    np.testing.assert_allclose(matches.distances, exact, atol=1e-3)


@pytest.mark.parametrize("num_query", [1, 31, 32, 33, 700])
def test_more_queries_than_fit_one_block(num_query):
    train = random_descriptors(0, 1000)
    order = np.random.default_rng(1).permutation(1000)[:num_query]
    matches = match_features(blurred(train[order], 2), train, MatchingConfig())
    assert np.array_equal(matches.query_idx, np.arange(num_query))
    assert np.array_equal(matches.train_idx, order)


def test_same_matches_for_any_number_of_threads():
    train = random_descriptors(0, 500)
    query = np.concatenate([blurred(train[:300], 1, 0.1), random_descriptors(2, 41)])
    alone = match_features(query, train, MatchingConfig(), num_threads=1)
    for num_threads in (2, 3, 200):
        several = match_features(query, train, MatchingConfig(), num_threads=num_threads)
        assert np.array_equal(several.query_idx, alone.query_idx)
        assert np.array_equal(several.train_idx, alone.train_idx)
        assert np.array_equal(several.distances, alone.distances)


def test_broken_descriptors_match_nothing():
    query, train = random_descriptors(0, 6), random_descriptors(1, 9)
    query[2] = np.nan
    assert 2 not in match_features(query, train, MatchingConfig(ratio=0.0, mutual=False)).query_idx


def test_equal_descriptors_are_matched():
    train = random_descriptors(0, 400)
    assert len(match_features(train, train, MatchingConfig())) == 400


def test_ratio_zero_takes_every_nearest_neighbour():
    query, train = random_descriptors(0, 50), random_descriptors(1, 30)
    assert len(match_features(query, train, MatchingConfig(ratio=0.0, mutual=False))) == 50


def test_mutual_keeps_one_query_a_train_feature():
    train = random_descriptors(0, 40)
    query = np.concatenate([blurred(train, 1), blurred(train, 2)])
    assert len(match_features(query, train, MatchingConfig(mutual=False))) == 80
    assert (
        len(set(match_features(query, train, MatchingConfig()).train_idx))
        == len(match_features(query, train, MatchingConfig()))
        == 40
    )


@pytest.mark.parametrize("method", ["exact", "flann"])
@pytest.mark.parametrize(("num_query", "num_train"), [(0, 5), (5, 0), (0, 0)])
def test_nothing_to_match(method, num_query, num_train):
    empty = match_features(
        np.zeros((num_query, 64), np.float32),
        np.zeros((num_train, 64), np.float32),
        MatchingConfig(method=method),
    )
    assert len(empty) == 0


def test_flann_finds_nearly_what_exact_finds_and_the_same_again():
    train = random_descriptors(0, 800)
    query = blurred(train, 1)
    exact, flann = (
        match_features(query, train, MatchingConfig(method=method)) for method in ("exact", "flann")
    )
    again = match_features(query, train, MatchingConfig(method="flann"))
    agreeing = set(zip(exact.query_idx, exact.train_idx, strict=True)) & set(
        zip(flann.query_idx, flann.train_idx, strict=True)
    )
    assert len(agreeing) > 0.8 * len(exact)
    assert np.array_equal(flann.query_idx, again.query_idx)
    assert np.array_equal(flann.train_idx, again.train_idx)


@pytest.mark.parametrize("method", ["exact", "flann"])
def test_twins_of_a_point_are_no_rivals_but_other_points_are(method):
    config = MatchingConfig(method=method, mutual=False)
    one_node = random_descriptors(0, 20)
    train = np.concatenate([one_node, blurred(one_node, 1, 0.01)])
    points = np.random.default_rng(2).uniform(-10, 10, (20, 3))
    query = blurred(one_node, 3, 0.01)
    radii = np.full(40, 0.1)
    assert len(match_features(query, train, config)) < 20
    same_place = match_pooled(query, train, np.concatenate([points, points + 0.05]), radii, config)
    assert np.array_equal(same_place.query_idx, np.arange(20))
    assert np.array_equal(same_place.train_idx % 20, np.arange(20))
    elsewhere = match_pooled(query, train, np.concatenate([points, points + 0.5]), radii, config)
    plain = match_features(query, train, config)
    assert np.array_equal(elsewhere.query_idx, plain.query_idx)


def test_the_wider_radius_of_the_two_decides():
    config = MatchingConfig(mutual=False)
    descriptor = random_descriptors(0, 1)
    train = np.concatenate([descriptor, descriptor])
    points = np.array([[0.0, 0.0, 5.0], [0.0, 0.0, 5.5]])
    assert len(match_pooled(descriptor, train, points, np.array([0.1, 0.6]), config)) == 1
    assert len(match_pooled(descriptor, train, points, np.array([0.1, 0.4]), config)) == 0


@pytest.mark.parametrize("num_train", [TILE - 1, TILE, TILE + 1, 3 * TILE + 7])
@pytest.mark.parametrize("ratio", [0.0, 0.8, 0.95])
def test_the_nearest_and_its_rivals_are_those_of_the_whole_table(num_train: int, ratio: float):
    """Cover each tile and lane. Of equal descriptors the first matches, and padding
    columns never match."""
    train = random_descriptors(1, num_train)
    query = blurred(train[np.random.default_rng(4).integers(0, num_train, 70)], 2, 0.15)
    train[num_train // 2] = blurred(query[7:8], 2, 0.1)[0]
    if num_train > TILE:
        train[TILE] = train[0] = query[5]  # two equal columns of one lane
    points, radii = np.random.default_rng(3).uniform(0, 2, (num_train, 3)), np.full(num_train, 0.8)
    matches = match_pooled(query, train, points, radii, MatchingConfig(ratio=ratio, mutual=False))
    products = np.array(
        [[float(np.sum(q.astype(np.float64) * t)) for t in train] for q in query]
    )  # a BLAS rounds columns differently
    expected = dict[int, int]()
    for row, of_row in enumerate(products):
        winner = int(of_row.argmax())
        limit = min(of_row[winner], 1 - (1 - of_row[winner]) / ratio**2) if ratio else np.inf
        rivals = np.flatnonzero(
            (of_row >= limit) & (np.linalg.norm(points - points[winner], axis=1) > 0.8)
        )
        if not np.any(rivals != winner):
            expected[row] = winner
    assert (
        dict(zip(matches.query_idx.tolist(), matches.train_idx.tolist(), strict=True)) == expected
    )
    assert len(expected) > 0


def test_broken_map_descriptors_match_nothing_and_break_no_other():
    query, train = random_descriptors(0, 40), random_descriptors(1, 120)
    train[17], train[50:90] = np.nan, blurred(query, 2)
    matches = match_features(query, train, MatchingConfig(ratio=0.0, mutual=False))
    assert np.array_equal(matches.train_idx, np.arange(50, 90))


@pytest.mark.parametrize("method", ["exact", "flann"])
def test_more_of_the_same_features_are_matched_as_if_they_were_the_first(method: str):
    """Mutual matching included: a later query feature that is nearer replaces the match of
    an earlier one."""
    train = random_descriptors(0, 500)
    query = np.concatenate(
        [blurred(train[:120], 1, 0.1), random_descriptors(2, 81), blurred(train[:200], 3, 0.02)]
    )
    points, radii = np.random.default_rng(4).uniform(0, 2, (500, 3)), np.full(500, 0.1)
    config = MatchingConfig(ratio=0.9, method=method)
    matcher = Matcher(query, train, (points, radii), config)
    for count in (120, 201, None):
        found, at_once = (
            matcher.match_first(count),
            match_pooled(query[:count], train, points, radii, config),
        )
        assert np.array_equal(found.query_idx, at_once.query_idx)
        assert np.array_equal(found.train_idx, at_once.train_idx)
        assert np.array_equal(found.distances, at_once.distances)
    first, every = (
        set(Matcher(query, train, (points, radii), config).match_first(120).query_idx),
        set(found.query_idx),
    )
    assert len(first - every) > 50


def test_of_equal_query_features_the_first_is_matched():
    train = random_descriptors(0, 30)
    query = np.concatenate([train, train])
    assert np.array_equal(match_features(query, train, MatchingConfig()).query_idx, np.arange(30))


@pytest.mark.parametrize(
    ("num_few", "num_many", "size"),
    [(128, 1501, 64), (3, 1, 64), (70, 300, 66), (0, 5, 64), (5, 0, 64)],
)
def test_pairs_that_are_alike_are_all_that_have_this_product_in_their_order(
    num_few: int, num_many: int, size: int
):
    few, many = random_descriptors(1, num_few, size), random_descriptors(2, num_many, size)
    rows, columns = find_similar_pairs(few, many, 0.2)
    expected = np.nonzero(few @ many.T >= np.float32(0.2))
    np.testing.assert_array_equal(rows, expected[0])
    np.testing.assert_array_equal(columns, expected[1])
