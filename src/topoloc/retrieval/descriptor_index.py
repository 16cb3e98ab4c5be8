"""Search whitened global descriptors (PCA, Jegou & Chum 2012) for nearest images, and rank the
nodes of these images."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
from jaxtyping import Float32, Int, Int8

from topoloc.compiled import kernel
from topoloc.errors import MapError
from topoloc.node_ids import Row
from topoloc.retrieval.coarse import CoarseModel, NodeScore, model_array

# Up to this number every vector is compared, in 1 to 3 ms. Beyond it an inverted file nearly always
# finds the same neighbour, if FAISS is installed.
MAX_EXACT_VECTORS = 8_000
# With an inverted file, this many of the nearest images are compared by more than their vectors.
NUM_RERANKED_IMAGES = 2_000
# Inverted file: cells searched per query, and training images per cell.
NUM_PROBES, IMAGES_PER_CELL = 24, 48
# This many images determine the axes. More images only cost memory and time (200 MB and 7 s with
# 2,000).
MAX_WHITENING_IMAGES = 1_000


class DescriptorIndex:
    """Search the unit vectors of the mapping images by inner product: exactly, or with FAISS's
    inverted file if there are many.

    Args:
        vectors: (n, d) unit vectors, one per mapping image.
        node_rows: (n,) the row of each image's node.
        max_exact: maximum number of vectors for the exact search.
    """

    def __init__(
        self,
        vectors: Float32[np.ndarray, "n d"],
        node_rows: Int[np.ndarray, " n"],
        max_exact: int = MAX_EXACT_VECTORS,
    ) -> None:
        self._node_rows = node_rows
        is_exact = len(vectors) <= max_exact or find_spec("faiss") is None
        vectors = np.ascontiguousarray(vectors)
        self._vectors = vectors if is_exact else None
        self._cells: Any = None if is_exact else _build_inverted_file(vectors)

    def rank_nodes(self, vector: Float32[np.ndarray, " d"], num_candidates: int) -> list[NodeScore]:
        """Return the distinct nodes of the nearest images with the similarity of their best image.
        Of equal images the earlier one counts."""
        if self._vectors is not None:
            return self.rank_images(*self.nearest(vector), num_candidates)
        num_images = 16 * num_candidates
        while True:
            rows, similarities = self._search_inverted_file(vector, num_images)
            ranking = self._best_image_per_node(rows, similarities, num_candidates)
            # Enough nodes, or no more images in the searched cells.
            if len(ranking) == num_candidates or len(rows) < num_images:
                return ranking
            num_images *= 8

    def nearest(
        self, vector: Float32[np.ndarray, " d"]
    ) -> tuple[Int[np.ndarray, " k"], Float32[np.ndarray, " k"]]:
        """Return all images and their similarities to a vector. With an inverted file, only the
        nearest images are returned."""
        if self._vectors is None:
            return self._search_inverted_file(vector, NUM_RERANKED_IMAGES)
        similarities = np.empty(len(self._vectors), np.float32)
        multiply_rows(self._vectors, np.ascontiguousarray(vector), similarities)
        return np.arange(len(self._vectors)), similarities

    def rank_images(
        self,
        images: Int[np.ndarray, " k"],
        similarities: Float32[np.ndarray, " k"],
        num_candidates: int,
    ) -> list[NodeScore]:
        """Return the nodes of the most similar of these images, as in `rank_nodes`."""
        order = np.argsort(-similarities, kind="stable")
        return self._best_image_per_node(images[order], similarities[order], num_candidates)

    def _search_inverted_file(
        self, vector: Float32[np.ndarray, " d"], num_images: int
    ) -> tuple[Int[np.ndarray, " k"], Float32[np.ndarray, " k"]]:
        num_images = min(num_images, len(self._node_rows))
        with single_faiss_thread():
            similarities, rows = self._cells.search(np.ascontiguousarray(vector[None]), num_images)
        found = rows[0] >= 0
        return rows[0][found], similarities[0][found]

    def _best_image_per_node(
        self,
        rows: Int[np.ndarray, " k"],
        similarities: Float32[np.ndarray, " k"],
        num_candidates: int,
    ) -> list[NodeScore]:
        _, first = np.unique(self._node_rows[rows], return_index=True)
        best = np.sort(first)[:num_candidates]
        return [NodeScore(Row(int(self._node_rows[rows[i]])), float(similarities[i])) for i in best]


def _build_inverted_file(vectors: Float32[np.ndarray, "n d"]) -> Any:
    """Build an inverted file with k-means centres of some of the vectors. Vectors are stored as
    half floats, half a kilobyte each at 256 dimensions."""
    import faiss

    num_cells = max(1, min(round(math.sqrt(len(vectors))), len(vectors) // 40))
    dimension = vectors.shape[1]
    kind, metric = faiss.ScalarQuantizer.QT_fp16, faiss.METRIC_INNER_PRODUCT
    centres = faiss.IndexFlatIP(dimension)
    index: Any = faiss.IndexIVFScalarQuantizer(centres, dimension, num_cells, kind, metric, False)
    index.cp.niter, index.cp.seed, index.cp.max_points_per_centroid = 8, 1, IMAGES_PER_CELL
    index.train(vectors)
    index.add(vectors)
    index.nprobe = NUM_PROBES
    return index


@dataclass(frozen=True, eq=False)
class Whitening:
    """Compute ``projection @ (vector - mean)``, scaled to unit length."""

    mean: Float32[np.ndarray, " d"]
    projection: Float32[np.ndarray, "p d"]

    def apply(self, raw: Float32[np.ndarray, "n d"]) -> Float32[np.ndarray, "n p"]:
        """Return the whitened unit vectors."""
        projected = (raw - self.mean) @ self.projection.T
        lengths = np.maximum(np.linalg.norm(projected, axis=1, keepdims=True), 1e-6)
        return np.ascontiguousarray(projected / lengths, np.float32)


def pack_projection(projection: Float32[np.ndarray, "p d"]) -> dict[str, np.ndarray]:
    """Return the arrays that store a projection in a third of its half floats: each row in steps of
    a tenth of its root mean square, compressed by zlib."""
    steps, sizes = _quantize(projection)
    packed = np.frombuffer(zlib.compress(steps.tobytes()), np.uint8)
    return {"projection": packed, "projection_steps": sizes}


def unpack_projection(model: CoarseModel, length: int) -> Float32[np.ndarray, "p d"]:
    """Return the projection, with rows of this length, of a stored model. Maps before schema 4 hold
    half floats. Raises MapError."""
    if "projection_steps" not in model.arrays:
        return model_array(model, "projection", "f", (None, length)).astype(np.float32)
    sizes = model_array(model, "projection_steps", "f", (None,)).astype(np.float32)
    packed, num_bytes = model_array(model, "projection", "u", (None,)), len(sizes) * length
    data = b""
    with suppress(zlib.error):
        data = zlib.decompressobj().decompress(packed.tobytes(), num_bytes)
    if len(data) != num_bytes:
        raise MapError(f"the map's coarse localizer {model.name!r} is damaged: its projection")
    return _dequantize(np.frombuffer(data, np.int8).reshape(-1, length), sizes)


def _quantize(
    projection: Float32[np.ndarray, "p d"],
) -> tuple[Int8[np.ndarray, "p d"], Float32[np.ndarray, " p"]]:
    sizes = np.maximum(0.1 * np.sqrt(np.mean(projection**2, axis=1)), 1e-12).astype(np.float32)
    return np.clip(np.rint(projection / sizes[:, None]), -127, 127).astype(np.int8), sizes


def _dequantize(
    steps: Int8[np.ndarray, "p d"], sizes: Float32[np.ndarray, " p"]
) -> Float32[np.ndarray, "p d"]:
    return steps * sizes[:, None]


def learn_whitening(
    raw: Float32[np.ndarray, "n d"] | Sequence[Float32[np.ndarray, " d"]], dimension: int
) -> Whitening:
    """Return the mean and the projection to at most `dimension` whitened components, from unit
    vectors of images.

    The mean variance is added to each variance. The trailing components of few images are noise,
    which plain whitening would amplify. The projection is rounded as `pack_projection` stores it:
    the vectors of a map and of its queries must use the same one.
    """
    rows = np.unique(np.linspace(0, len(raw) - 1, MAX_WHITENING_IMAGES).astype(int)).tolist()
    centred = np.stack([raw[k] for k in rows])
    mean = centred.mean(axis=0)
    centred -= mean
    # Use the smaller matrix: products of images or products of dimensions.
    by_image = len(centred) < centred.shape[1]
    eigenvalues, vectors = np.linalg.eigh(centred @ centred.T if by_image else centred.T @ centred)
    order = np.argsort(-eigenvalues, kind="stable")[:dimension]
    # Vectors have unit length, so values below a millionth of it are rounding.
    keep = order[eigenvalues[order] > 1e-6 * max(float(eigenvalues.max()), len(centred) * 1e-6)]
    if len(keep) == 0:  # one image, or all alike
        direction = mean / max(float(np.linalg.norm(mean)), 1e-6)
        return Whitening(np.zeros_like(mean), direction[None].astype(np.float32))
    axes = vectors[:, keep]
    if by_image:
        axes = centred.T @ axes / np.sqrt(eigenvalues[keep])
    regularized = np.sqrt(eigenvalues[keep] + eigenvalues[keep].mean())
    projection = np.ascontiguousarray((axes / regularized).T, np.float32)
    return Whitening(mean.astype(np.float32), _dequantize(*_quantize(projection)))


def learn_visual_words(
    descriptors: Float32[np.ndarray, "n d"], num_words: int, seed: int
) -> Float32[np.ndarray, "k d"]:
    """Return the k-means centres (Lloyd 1982) of descriptors, fewer than `num_words` if there are
    few descriptors. At most 256 descriptors a word are used."""
    num_words = max(1, min(num_words, len(descriptors) // 40))
    order = np.random.default_rng(seed).permutation(len(descriptors))[: 256 * num_words]
    sample = np.ascontiguousarray(descriptors[order], np.float32)
    words = sample[:num_words].copy()
    for _ in range(20):
        nearest = _find_nearest_words(sample, words)
        by_word = np.argsort(nearest, kind="stable")
        used, starts, counts = np.unique(nearest[by_word], return_index=True, return_counts=True)
        words[used] = np.add.reduceat(sample[by_word], starts) / counts[:, None]
    return words


def _find_nearest_words(
    sample: Float32[np.ndarray, "n d"], words: Float32[np.ndarray, "k d"]
) -> Int[np.ndarray, " n"]:
    rows = max(1, 2**24 // len(words))  # 64 MB of products at a time
    half_squares = 0.5 * np.sum(words**2, axis=1)
    blocks = (sample[start : start + rows] for start in range(0, len(sample), rows))
    return np.concatenate([np.argmax(one @ words.T - half_squares, axis=1) for one in blocks])


@contextmanager
def single_faiss_thread() -> Iterator[None]:
    """Run FAISS in a single thread. Its threads wait for each other in busy loops, which takes ten
    times as long on a loaded machine.

    FAISS has one number of threads for each Python thread. So Python threads need no lock here.
    """
    import faiss

    before = faiss.omp_get_max_threads()
    faiss.omp_set_num_threads(1)
    try:
        yield
    finally:
        faiss.omp_set_num_threads(before)


# BLAS and FAISS would start threads for these products, which take a fraction of a millisecond.
# Waking the threads costs more than they save, and many times more on a busy machine.
_FAST_MATH = {"reassoc", "contract", "arcp"}


@kernel(error_model="numpy", fastmath=_FAST_MATH)
def _dot(a, b):
    total = np.float32(0)
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@kernel(error_model="numpy", fastmath=_FAST_MATH)
def add_residuals(descriptors, words, half_squares, sums):
    """Add each descriptor's unit residual from its nearest word to that word's row of `sums`.
    half_squares = |word|^2 / 2."""
    residual = np.empty(words.shape[1], np.float32)
    for n in range(len(descriptors)):
        descriptor = descriptors[n]
        nearest, best = 0, np.float32(-np.inf)
        for k in range(len(words)):
            # The part of |d - w|^2 that depends on the word.
            score = _dot(descriptor, words[k]) - half_squares[k]
            if score > best:
                nearest, best = k, score
        word, total = words[nearest], sums[nearest]
        for i in range(len(residual)):
            residual[i] = descriptor[i] - word[i]
        scale = np.float32(1) / max(np.sqrt(_dot(residual, residual)), np.float32(1e-6))
        for i in range(len(residual)):
            total[i] += residual[i] * scale


@kernel(error_model="numpy", fastmath=_FAST_MATH)
def multiply_rows(rows, vector, products):
    """Compute products[k] = rows[k] . vector."""
    for k in range(len(rows)):
        products[k] = _dot(rows[k], vector)


@kernel(error_model="numpy", fastmath=_FAST_MATH)
def max_shifted_products(rows, chosen, vector, column, max_shift, products):
    """Compute products[k], the maximum of rows[chosen[k]] . vector over shifts by up to `max_shift`
    columns of `column` numbers in both directions.

    Only columns present in both are multiplied, and the product is divided by their number.
    """
    length = len(vector)
    for k in range(len(chosen)):
        best, row = np.float32(-np.inf), rows[chosen[k]]
        for shift in range(-max_shift, max_shift + 1):
            left, right = max(shift, 0) * column, max(-shift, 0) * column
            both = length - abs(shift) * column
            product = _dot(row[left : left + both], vector[right : right + both])
            best = max(best, product * np.float32(column) / np.float32(both))
        products[k] = best
