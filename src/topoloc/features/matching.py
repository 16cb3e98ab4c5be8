"""Match descriptors: nearest neighbour, ratio test (Lowe, 2004) and mutual check.

`exact` compares all pairs with one matrix product. `flann` is the paper's method: randomised
KD-trees ("FLANN-based matching", section III-B). Descriptors must have unit length, so that
distance^2 = 2 - 2 product.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, Int32

from topoloc.compiled import parallel_for_rows
from topoloc.features.features import Matches, MatchingConfig
from topoloc.features.matching_kernels import (
    GROUP,
    ROWS,
    TILE,
    find_nearest,
    find_similar,
    largest_products,
)

_LOWE_RATIO = 0.8
_FLANN_KDTREE = 1
_FLANN_NEIGHBOURS = 8  # the nearest of these that is not a duplicate is the rival
_NO_POINTS, _NO_RADII = np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
_NO_RATIO_TEST = MatchingConfig(ratio=0.0)


def match_features(
    query_descriptors: Float32[np.ndarray, "n d"],
    train_descriptors: Float32[np.ndarray, "m d"],
    config: MatchingConfig,
    num_threads: int | None = None,
) -> Matches:
    """Return matches between two images, at most one per query feature, in the order of the query
    features."""
    return Matcher(query_descriptors, train_descriptors, None, config, num_threads).match_first()


def match_pooled(
    query_descriptors: Float32[np.ndarray, "n d"],
    train_descriptors: Float32[np.ndarray, "m d"],
    train_points_world: Float[np.ndarray, "m 3"],
    train_radii: Float[np.ndarray, " m"],
    config: MatchingConfig,
) -> Matches:
    """Return matches between an image and the pooled features of several map nodes.

    Neighbouring nodes may hold the same physical point more than once. Such duplicates are not
    rivals in the ratio test. Two features are duplicates if their points lie within the larger of
    their two `train_radii` (metres, from the depth error).
    """
    points = train_points_world, train_radii
    return Matcher(query_descriptors, train_descriptors, points, config).match_first()


def find_similar_pairs(
    few: Float32[np.ndarray, "n d"], many: Float32[np.ndarray, "m d"], min_similarity: float
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Return pairs of rows of `few` and of `many` whose descriptors have a scalar product of at
    least `min_similarity` (above 0). Pairs are sorted by the row of `few`, then by the row of
    `many`."""
    if not len(few) or not len(many):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    packed = _packed(few)  # only the few are packed, so that the many need not be rearranged
    found = find_similar(_padded(many, packed), packed, len(few), np.float32(min_similarity))
    found = found[np.argsort(found[:, 1], kind="stable")]
    return found[:, 1], found[:, 0]


def largest_similarities(
    few: Float32[np.ndarray, "f d"], groups: Sequence[Float32[np.ndarray, "n d"]]
) -> Float32[np.ndarray, "groups f"]:
    """Return the largest scalar product of a descriptor of each group with each of a few
    descriptors, at least 0."""
    packed, largest = _packed(few), np.zeros((len(groups), len(few)), np.float32)

    def run(first_group: int, last_group: int) -> None:
        for row in range(first_group, last_group):
            largest_products(_padded(groups[row], packed), packed, largest[row])

    parallel_for_rows(run, len(groups))
    return largest


class Matcher:
    """Match like `match_pooled`, first with a few query features, then with more. Features that
    were compared before are not compared again.

    Args:
        map_points: the points (m, 3) of the train features and their radii (m), metres. None: each
            feature is a point of its own.
    """

    def __init__(
        self,
        query_descriptors: Float32[np.ndarray, "n d"],
        train_descriptors: Float32[np.ndarray, "m d"],
        map_points: tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, " m"]] | None,
        config: MatchingConfig,
        num_threads: int | None = None,
    ) -> None:
        self._query, self._train = query_descriptors, train_descriptors
        self._points, self._radii = (
            each.astype(np.float32) for each in map_points or (_NO_POINTS, _NO_RADII)
        )
        self._config, self._num_threads = config, num_threads
        self._ratio = _LOWE_RATIO if config.ratio is None else config.ratio
        self._nearest = np.zeros(0, np.int32), np.zeros(0, np.float32)
        self._packed = _packed(train_descriptors)
        self._column_largest = np.full(TILE * len(self._packed), -np.inf, np.float32)

    def match_first(self, count: int | None = None) -> Matches:
        """Return the matches of the first `count` query features, or of all by default. `count`
        must not be smaller than in earlier calls."""
        query = self._query[:count]
        if len(query) == 0 or len(self._train) == 0:
            return Matches(np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros(0, np.float32))
        if self._config.method == "flann":
            return self._match_with_flann(query)
        train_idx, products = self._match_rows(query)
        query_idx = np.flatnonzero(train_idx >= 0).astype(np.int32)
        if self._config.mutual:
            query_idx = query_idx[products[query_idx] >= self._column_largest[train_idx[query_idx]]]
            _, first_of_equal = np.unique(train_idx[query_idx], return_index=True)
            query_idx = np.sort(query_idx[first_of_equal])
        return _matches(query_idx, train_idx, products)

    def _match_rows(
        self, query: Float32[np.ndarray, "n d"]
    ) -> tuple[Int32[np.ndarray, " n"], Float32[np.ndarray, " n"]]:
        """Return the nearest train row of each query row and their scalar product. The row is -1 if
        the ratio test fails. Rows that were compared before are not compared again."""
        query = query[len(self._nearest[0]) :]
        padded, compared = _padded(query, self._packed), (self._ratio, self._points, self._radii)
        train_idx, products = np.empty(len(query), np.int32), np.empty(len(query), np.float32)
        band_maxima = list[np.ndarray]()

        def run(first_pair: int, last_pair: int) -> None:
            rows = slice(ROWS * first_pair, ROWS * last_pair)
            band_maximum = np.full_like(self._column_largest, -np.inf)
            find_nearest(
                padded[rows], self._packed, len(self._train), *compared, train_idx[rows], products[rows], band_maximum  # noqa: E501
            )  # fmt: skip
            band_maxima.append(band_maximum)

        parallel_for_rows(run, len(padded) // ROWS, self._num_threads)
        for band_maximum in band_maxima:
            np.maximum(self._column_largest, band_maximum, out=self._column_largest)
        known_idx, known_products = self._nearest
        self._nearest = (
            np.concatenate([known_idx, train_idx]),
            np.concatenate([known_products, products]),
        )
        return self._nearest

    def _match_with_flann(self, query: Float32[np.ndarray, "n d"]) -> Matches:
        train_idx, products = self._nearest_flann(query)
        query_idx = np.flatnonzero(train_idx >= 0).astype(np.int32)
        if self._config.mutual and len(query_idx):
            queried, queried_inverse = np.unique(train_idx[query_idx], return_inverse=True)
            back = Matcher(self._train[queried], query, None, _NO_RATIO_TEST, self._num_threads)
            back_idx, _ = back._match_rows(self._train[queried])
            query_idx = query_idx[back_idx[queried_inverse] == query_idx]
        return _matches(query_idx, train_idx, products)

    def _nearest_flann(
        self, query: Float32[np.ndarray, "n d"]
    ) -> tuple[Int32[np.ndarray, " n"], Float32[np.ndarray, " n"]]:
        """Compute `_match_rows` with approximate neighbours."""
        trees, checks = 5, 50  # FLANN: number of KD-trees, and of leaves visited per query
        cv2.setRNGSeed(0)  # the trees split at random, but two runs must be byte-identical
        matcher = cv2.FlannBasedMatcher(
            {"algorithm": _FLANN_KDTREE, "trees": trees}, {"checks": checks}
        )
        train_idx, products = np.full(len(query), -1, np.int32), np.zeros(len(query), np.float32)
        num = 2 if len(self._points) == 0 else _FLANN_NEIGHBOURS
        found = matcher.knnMatch(*map(np.ascontiguousarray, (query, self._train)), k=num)
        for row, neighbours in enumerate(found):
            if not neighbours:
                continue
            best, *others = neighbours
            products[row] = 1.0 - best.distance**2 / 2.0
            rival = next(
                (k for k in others if not self._are_duplicates(best.trainIdx, k.trainIdx)), None
            )
            if self._ratio <= 0.0 or not rival or best.distance < self._ratio * rival.distance:
                train_idx[row] = best.trainIdx
        return train_idx, products

    def _are_duplicates(self, a: int, b: int) -> bool:
        if len(self._points) == 0:
            return False
        distance = np.linalg.norm(self._points[a] - self._points[b])
        return bool(distance <= max(self._radii[a], self._radii[b]))


def _matches(
    query_idx: Int32[np.ndarray, " k"],
    train_idx: Int32[np.ndarray, " n"],
    products: Float32[np.ndarray, " n"],
) -> Matches:
    """Return the matches of the query rows `query_idx`. `train_idx` and `products` are indexed by
    query row."""
    distances = np.sqrt(np.maximum(2.0 - 2.0 * products[query_idx], 0.0)).astype(np.float32)
    return Matches(query_idx, train_idx[query_idx], distances)


def _padded(
    query: Float32[np.ndarray, "n d"], packed: Float32[np.ndarray, "tiles groups width"]
) -> Float32[np.ndarray, "n2 d2"]:
    """Pad descriptors with zeros to whole groups of rows and components, as `multiply` requires
    beside `packed`."""
    padded = np.zeros((-(-len(query) // ROWS) * ROWS, GROUP * packed.shape[1]), np.float32)
    padded[: len(query), : query.shape[1]] = query
    return padded


def _packed(train: Float32[np.ndarray, "m d"]) -> Float32[np.ndarray, "tiles groups width"]:
    """Pack descriptors into tiles. Row k of a tile holds the components 4k .. 4k + 3 of its
    descriptors, one component of all descriptors after the other."""
    num_tiles, num_groups = -(-len(train) // TILE), -(-train.shape[1] // GROUP)
    padded = np.zeros((num_tiles * TILE, num_groups * GROUP), np.float32)
    padded[: len(train), : train.shape[1]] = train
    tiles = padded.reshape(num_tiles, TILE, num_groups, GROUP).transpose(0, 2, 3, 1)
    return np.ascontiguousarray(tiles).reshape(num_tiles, num_groups, GROUP * TILE)
