"""Nearest neighbours among place vectors, and the nodes they vote for."""

from __future__ import annotations

import math
from typing import Any

import faiss
import numpy as np
from jaxtyping import Float32, Int

from topoloc.places.coarse import NodeScore
from topoloc.places.place_kernels import multiply_rows

# Up to here every vector is compared, in 1 to 3 ms; beyond it an inverted file finds the same neighbour nearly always.
MAX_EXACT_VECTORS = 8_000
# Of an inverted file: cells that a query looks into, images that its cells are learnt from, of each.
NUM_PROBES, IMAGES_PER_CELL = 24, 48


class PlaceIndex:
    """Inner-product search over the unit vectors of the mapping images: exact, or by cells (FAISS's inverted file) where they are many.

    Args:
        vectors: (n, d) unit vectors, one a mapping image.
        node_ids: (n,) the node of each.
        max_exact: with more vectors than this the search is by cells.
    """

    def __init__(self, vectors: Float32[np.ndarray, "n d"], node_ids: Int[np.ndarray, " n"], max_exact: int = MAX_EXACT_VECTORS) -> None:
        self._node_ids = node_ids
        self._vectors = np.ascontiguousarray(vectors) if len(vectors) <= max_exact else None
        self._cells = None if len(vectors) <= max_exact else _inverted_file(np.ascontiguousarray(vectors))

    def rank_nodes(self, vector: Float32[np.ndarray, " d"], num_candidates: int) -> list[NodeScore]:
        """The nodes of the nearest images, each once, with the similarity of its best image; of equal ones the earlier image's."""
        if self._vectors is not None:
            similarities = np.empty(len(self._vectors), np.float32)
            multiply_rows(self._vectors, np.ascontiguousarray(vector), similarities)
            order = np.argsort(-similarities, kind="stable")
            return self._best_of_each_node(order, similarities[order], num_candidates)
        num_images = 16 * num_candidates
        while True:
            rows, similarities = self._search_cells(vector, num_images)
            ranking = self._best_of_each_node(rows, similarities, num_candidates)
            if len(ranking) == num_candidates or len(rows) < num_images:  # enough, or no more in the cells looked into
                return ranking
            num_images *= 8

    def _search_cells(self, vector: Float32[np.ndarray, " d"], num_images: int) -> tuple[Int[np.ndarray, " k"], Float32[np.ndarray, " k"]]:
        assert self._cells is not None
        similarities, rows = self._cells.search(np.ascontiguousarray(vector[None]), min(num_images, len(self._node_ids)))
        found = rows[0] >= 0
        return rows[0][found], similarities[0][found]

    def _best_of_each_node(
        self, rows: Int[np.ndarray, " k"], similarities: Float32[np.ndarray, " k"], num_candidates: int
    ) -> list[NodeScore]:
        _, first = np.unique(self._node_ids[rows], return_index=True)
        best = np.sort(first)[:num_candidates]
        return [NodeScore(int(self._node_ids[rows[i]]), float(similarities[i])) for i in best]


def _inverted_file(vectors: Float32[np.ndarray, "n d"]) -> Any:
    """Cells about the k-means centres of some of the vectors; the vectors in them as half floats, half a kilobyte at 256 dimensions."""
    num_cells = max(1, min(round(math.sqrt(len(vectors))), len(vectors) // 40))
    dimension = vectors.shape[1]
    index = faiss.IndexIVFScalarQuantizer(
        faiss.IndexFlatIP(dimension), dimension, num_cells, faiss.ScalarQuantizer.QT_fp16, faiss.METRIC_INNER_PRODUCT, False
    )
    index.cp.niter, index.cp.seed, index.cp.max_points_per_centroid = 8, 1, IMAGES_PER_CELL
    index.train(vectors)  # pyright: ignore[reportCallIssue]
    index.add(vectors)  # pyright: ignore[reportCallIssue]
    index.nprobe = NUM_PROBES
    return index
