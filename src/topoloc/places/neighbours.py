"""Nearest neighbours among place vectors, by FAISS, and the nodes they vote for."""

from __future__ import annotations

import faiss
import numpy as np
from jaxtyping import Float32, Int

from topoloc.places.coarse import NodeScore


class PlaceIndex:
    """Exact inner-product search over the unit vectors of the mapping images.

    Args:
        vectors: (n, d) unit vectors, one a mapping image.
        node_ids: (n,) the node of each.
    """

    def __init__(self, vectors: Float32[np.ndarray, "n d"], node_ids: Int[np.ndarray, " n"]) -> None:
        self._node_ids = node_ids
        self._index = faiss.IndexFlatIP(vectors.shape[1])
        self._index.add(np.ascontiguousarray(vectors))  # pyright: ignore[reportCallIssue]

    def rank_nodes(self, vector: Float32[np.ndarray, " d"], num_candidates: int) -> list[NodeScore]:
        """The nodes of the nearest images, each once, with the similarity of its best image."""
        num_images = min(len(self._node_ids), 16 * num_candidates)
        similarities, rows = self._index.search(vector[None], num_images)  # pyright: ignore[reportCallIssue]
        best: dict[int, float] = {}
        for similarity, row in zip(similarities[0], rows[0], strict=True):
            best.setdefault(int(self._node_ids[row]), float(similarity))
            if len(best) == num_candidates:
                break
        return [NodeScore(node_id, score) for node_id, score in best.items()]
