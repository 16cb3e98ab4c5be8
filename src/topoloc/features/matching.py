"""Match descriptors: nearest neighbour, ratio test (Lowe, 2004) and mutual check.

`exact` compares all pairs with one matrix product. `flann` is the paper's method: randomised
KD-trees ("FLANN-based matching", section III-B). Descriptors must have unit length, so that
distance^2 = 2 - 2 product.

The product does not use a BLAS. A threaded BLAS waits for its threads in a busy loop. Beside
another busy program each call then costs a time slice of the scheduler, some 15 ms. The kernel is
about as fast as a BLAS on one thread.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, Int32

from topoloc.compiled import kernel, parallel_for_rows
from topoloc.features.features import Matches, MatchingConfig

# Columns of a block of train descriptors, which stays in the first-level cache. With a power of
# two, rows would share its lines.
TILE = 96
ROWS = 2  # query rows processed together; with GROUP components they fit into the registers
GROUP = 4
# A multiple of ROWS. Their products are read again while they are still in the cache.
ROWS_AT_ONCE = 32
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
    found = _find_similar(_padded(many, packed), packed, len(few), np.float32(min_similarity))
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
            _largest_products(_padded(groups[row], packed), packed, largest[row])

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
            _find_nearest(
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
    """Pad descriptors with zeros to whole groups of rows and components, as `_multiply` requires
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


@kernel(fastmath={"contract"})
def _multiply(query, packed, out):
    """Compute out[i, j] = query[i] . train[j]. The number of query rows must be a multiple of ROWS.
    `packed` comes from `_packed`."""
    sums = np.empty(ROWS * TILE, np.float32)
    for tile in range(packed.shape[0]):
        for i in range(0, query.shape[0] - ROWS + 1, ROWS):
            sums[:] = np.float32(0.0)
            a, b = query[i], query[i + 1]
            for k in range(packed.shape[1]):
                t = packed[tile, k]
                a0, a1, a2, a3 = a[4 * k], a[4 * k + 1], a[4 * k + 2], a[4 * k + 3]
                b0, b1, b2, b3 = b[4 * k], b[4 * k + 1], b[4 * k + 2], b[4 * k + 3]
                for j in range(TILE):
                    t0, t1, t2, t3 = t[j], t[TILE + j], t[2 * TILE + j], t[3 * TILE + j]
                    sums[j] = sums[j] + a0 * t0 + a1 * t1 + a2 * t2 + a3 * t3
                    sums[TILE + j] = sums[TILE + j] + b0 * t0 + b1 * t1 + b2 * t2 + b3 * t3
            for row in range(ROWS):
                for j in range(TILE):
                    out[i + row, tile * TILE + j] = sums[row * TILE + j]


@kernel()
def _find_similar(query, packed, num_columns, least):
    """Return (row, column) of all products of at least `least`, an array (k, 2).

    `query` and `packed` are those of `_multiply`. Columns from `num_columns` on are ignored.
    """
    products = np.empty((ROWS, TILE * packed.shape[0]), np.float32)
    found, count = np.empty((1024, 2), np.int64), 0
    for i in range(0, query.shape[0] - ROWS + 1, ROWS):
        _multiply(query[i : i + ROWS], packed, products)
        for row in range(ROWS):
            total = np.int32(0)
            for column in range(num_columns):  # without branches, so that the loop vectorises
                total += np.int32(products[row, column] >= least)
            if total == 0:
                continue
            while count + total > found.shape[0]:
                found = np.concatenate((found, np.empty_like(found)))
            for column in range(num_columns):
                if products[row, column] >= least:
                    found[count, 0] = i + row
                    found[count, 1] = column
                    count += 1
    return found[:count]


@kernel()
def _largest_products(rows, packed, out):
    """Raise out[column] to the largest product of a row with it. `rows` and `packed` are `query`
    and `packed` of `_multiply`."""
    products = np.empty((ROWS, TILE * packed.shape[0]), np.float32)
    for i in range(0, rows.shape[0] - ROWS + 1, ROWS):
        _multiply(rows[i : i + ROWS], packed, products)
        for row in range(ROWS):
            for column in range(len(out)):
                product = products[row, column]
                out[column] = product if product > out[column] else out[column]


@kernel()
def _are_duplicates(points, radii, a, b):
    squared = np.float32(0.0)
    for axis in range(3):
        squared += (points[a, axis] - points[b, axis]) ** 2
    return squared <= max(radii[a], radii[b]) ** 2


@kernel()
def _find_nearest(
    query, packed, num_columns, ratio, points, radii, out_winner, out_product, column_largest
):
    """Write the column of the largest product of each query row (the first of equal ones) and that
    product.

    The column is -1 if the winner fails the ratio test or if no product is comparable (NaN).
    `query` and `packed` are those of `_multiply`. Columns from `num_columns` on are ignored.

    Column k belongs to the map point `points[k]`. Columns within `radii` of the winner's point are
    duplicates and not rivals. Without points (0, 3), every other column is a rival. A ratio of 0
    disables the test. The length of `out_winner` is the number of query rows. `column_largest` is
    updated with the largest product of each column.
    """
    table = np.empty((ROWS_AT_ONCE, TILE * packed.shape[0]), np.float32)
    lanes = np.empty(TILE, np.float32)
    for start in range(0, query.shape[0], ROWS_AT_ONCE):
        stop = min(start + ROWS_AT_ONCE, query.shape[0])
        _multiply(query[start:stop], packed, table)
        for k in range(min(stop, len(out_winner)) - start):
            row = table[k]
            row[num_columns:] = -np.inf  # so that whole tiles can be searched
            best = _row_maximum(row, lanes, column_largest)
            out_product[start + k] = best
            out_winner[start + k] = (
                -1 if best == -np.inf else _find_unambiguous(row, lanes, best, ratio, points, radii)
            )


@kernel()
def _row_maximum(row, lanes, column_largest):
    """Return the maximum of whole tiles of products. NaN is ignored. `lanes[j]` becomes the maximum
    over column j of all tiles."""
    lanes[:] = -np.inf
    for tile in range(len(row) // TILE):
        part = row[tile * TILE : (tile + 1) * TILE]
        above = column_largest[tile * TILE : (tile + 1) * TILE]
        for j in range(TILE):  # each lane by itself, so that the loop vectorises
            lanes[j] = part[j] if part[j] > lanes[j] else lanes[j]
        for j in range(TILE):
            above[j] = part[j] if part[j] > above[j] else above[j]
    best = lanes[0]
    for j in range(1, TILE):
        best = max(best, lanes[j])
    return best


@kernel()
def _find_unambiguous(row, lanes, best, ratio, points, radii):
    """Return the first column with the largest product, or -1 if it has a rival. Only lanes that
    can hold such columns are searched."""
    winner = len(row)
    for j in range(TILE):
        if lanes[j] == best:
            for column in range(j, winner, TILE):
                if row[column] == best:
                    winner = column
                    break
    if ratio <= 0.0:
        return winner
    # d1 < ratio * d2 with d^2 = 2 - 2 product. A rival reaches this product. Rounding may raise
    # `best` above 1.
    limit = min(best, np.float32(1.0 - (1.0 - best) / ratio**2))
    for j in range(TILE):
        if lanes[j] >= limit:
            for column in range(j, len(row), TILE):
                if (
                    row[column] >= limit
                    and column != winner
                    and (len(points) == 0 or not _are_duplicates(points, radii, winner, column))
                ):
                    return -1
    return winner
