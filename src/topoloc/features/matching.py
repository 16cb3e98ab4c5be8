"""Match descriptors: nearest neighbour, ratio test (Lowe, 2004) and mutual check.

`exact` compares all pairs with one matrix product. `flann` is the paper's method: randomised
KD-trees ("FLANN-based matching", section III-B). Descriptors must have unit length, so that
distance^2 = 2 - 2 product.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, Int32

from topoloc.features.config import MatchingConfig
from topoloc.features.features import Matches
from topoloc.features.matching_kernels import GROUP, ROWS, TILE, find_nearest, find_similar
from topoloc.features.parallel import parallel_for_rows

_LOWE_RATIO = 0.8
_FLANN_KDTREE = 1
_FLANN_NEIGHBOURS = 8  # the nearest of these that is not a duplicate is the rival
_NO_POINTS = np.zeros((0, 3), np.float32)
_NO_RADII = np.zeros(0, np.float32)


_NO_RATIO_TEST = MatchingConfig(ratio=0.0)
_TrainSet = tuple[int, float, Float32[np.ndarray, "p 3"], Float32[np.ndarray, " p"]]
"""The number of train features, the ratio, and the points and radii of the train features."""


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
    num_threads: int | None = None,
) -> Matches:
    """Return matches between an image and the pooled features of several map nodes.

    Neighbouring nodes may hold the same physical point more than once. Such duplicates are not
    rivals in the ratio test. Two features are duplicates if their points lie within the larger of
    their two `train_radii` (metres, from the depth error).
    """
    return Matcher(
        query_descriptors, train_descriptors, (train_points_world, train_radii), config, num_threads
    ).match_first()


def find_similar_pairs(
    few: Float32[np.ndarray, "n d"], many: Float32[np.ndarray, "m d"], min_similarity: float
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Return pairs of rows of `few` and of `many` whose descriptors have a scalar product of at
    least `min_similarity` (above 0). Pairs are sorted by the row of `few`, then by the row of
    `many`."""
    found, count = np.empty((1024, 2), np.int64), 0
    if len(few) and len(many):
        # only the few are packed, so that the many need not be rearranged
        packed = _packed(few)
        found, count = find_similar(
            _padded(many, packed), packed, len(few), np.float32(min_similarity), found, count
        )
    found = found[:count]
    found = found[np.argsort(found[:, 1], kind="stable")]
    return found[:, 1], found[:, 0]


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
            (_NO_POINTS, _NO_RADII)
            if map_points is None
            else (each.astype(np.float32) for each in map_points)
        )
        self._config, self._num_threads = config.resolved(_LOWE_RATIO), num_threads
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
            query_idx = np.sort(
                query_idx[np.unique(train_idx[query_idx], return_index=True)[1]]
            )  # the first of equal ones
        return _matches(query_idx, train_idx, products)

    def _match_rows(
        self, query: Float32[np.ndarray, "n d"]
    ) -> tuple[Int32[np.ndarray, " n"], Float32[np.ndarray, " n"]]:
        """Return the nearest train row of each query row and their scalar product. The row is -1 if
        the ratio test fails."""
        train_idx, products = self._nearest
        more = _nearest(
            query[len(train_idx) :],
            self._packed,
            self._train_set,
            self._column_largest,
            self._num_threads,
        )
        self._nearest = np.concatenate([train_idx, more[0]]), np.concatenate([products, more[1]])
        return self._nearest

    @property
    def _train_set(self) -> _TrainSet:
        assert self._config.ratio is not None
        return len(self._train), self._config.ratio, self._points, self._radii

    def _match_with_flann(self, query: Float32[np.ndarray, "n d"]) -> Matches:
        train_idx, products = _nearest_flann(
            query, self._train, self._points, self._radii, self._config
        )
        query_idx = np.flatnonzero(train_idx >= 0).astype(np.int32)
        if self._config.mutual and len(query_idx):
            queried, queried_inverse = np.unique(train_idx[query_idx], return_inverse=True)
            back_idx = Matcher(
                self._train[queried], query, None, _NO_RATIO_TEST, self._num_threads
            )._match_rows(self._train[queried])[0]
            query_idx = query_idx[back_idx[queried_inverse] == query_idx]
        return _matches(query_idx, train_idx, products)


def _matches(
    query_idx: Int32[np.ndarray, " k"],
    train_idx: Int32[np.ndarray, " n"],
    products: Float32[np.ndarray, " n"],
) -> Matches:
    """Return the matches of the query rows `query_idx`. `train_idx` and `products` are indexed by
    query row."""
    distances = np.sqrt(np.maximum(2.0 - 2.0 * products[query_idx], 0.0)).astype(np.float32)
    return Matches(query_idx, train_idx[query_idx], distances)


def _nearest(
    query: Float32[np.ndarray, "n d"],
    packed: Float32[np.ndarray, "tiles groups width"],
    compared: _TrainSet,
    column_largest: Float32[np.ndarray, " columns"],
    num_threads: int | None,
) -> tuple[Int32[np.ndarray, " n"], Float32[np.ndarray, " n"]]:
    """Return the nearest train row of each query row and their scalar product. The row is -1 if the
    ratio test fails. `column_largest` is updated with the largest product of each column."""
    padded = _padded(query, packed)
    nearest_idx, products = np.empty(len(query), np.int32), np.empty(len(query), np.float32)
    band_maxima = list[np.ndarray]()

    def run(first_pair: int, last_pair: int) -> None:
        rows, band_maximum = (
            slice(ROWS * first_pair, ROWS * last_pair),
            np.full_like(column_largest, -np.inf),
        )
        find_nearest(
            padded[rows], packed, *compared, nearest_idx[rows], products[rows], band_maximum
        )
        band_maxima.append(band_maximum)

    parallel_for_rows(run, len(padded) // ROWS, num_threads)
    for band_maximum in band_maxima:
        np.maximum(column_largest, band_maximum, out=column_largest)
    return nearest_idx, products


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


def _nearest_flann(
    query: Float32[np.ndarray, "n d"],
    train: Float32[np.ndarray, "m d"],
    points: Float32[np.ndarray, "p 3"],
    radii: Float32[np.ndarray, " p"],
    config: MatchingConfig,
) -> tuple[Int32[np.ndarray, " n"], Float32[np.ndarray, " n"]]:
    """Compute `_nearest` with approximate neighbours."""
    trees = 5  # FLANN: number of KD-trees
    checks = 50  # FLANN: number of leaves visited per query
    assert config.ratio is not None
    cv2.setRNGSeed(0)  # the trees split at random, but two runs must be byte-identical
    matcher = cv2.FlannBasedMatcher(
        {"algorithm": _FLANN_KDTREE, "trees": trees}, {"checks": checks}
    )
    found = matcher.knnMatch(
        np.ascontiguousarray(query),
        np.ascontiguousarray(train),
        k=2 if len(points) == 0 else _FLANN_NEIGHBOURS,
    )
    nearest_idx, products = np.full(len(query), -1, np.int32), np.zeros(len(query), np.float32)
    for row, neighbours in enumerate(found):
        if not neighbours:
            continue
        best = neighbours[0]
        products[row] = 1.0 - best.distance**2 / 2.0
        others = [
            other
            for other in neighbours[1:]
            if not _are_duplicates(points, radii, best.trainIdx, other.trainIdx)
        ]
        if config.ratio <= 0.0 or not others or best.distance < config.ratio * others[0].distance:
            nearest_idx[row] = best.trainIdx
    return nearest_idx, products


def _are_duplicates(
    points: Float32[np.ndarray, "p 3"], radii: Float32[np.ndarray, " p"], a: int, b: int
) -> bool:
    return len(points) > 0 and bool(
        np.linalg.norm(points[a] - points[b]) <= max(radii[a], radii[b])
    )
