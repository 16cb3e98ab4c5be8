"""Nearest neighbours among place vectors, and the nodes they vote for."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Int

from topoloc.places.coarse import NodeScore
from topoloc.places.place_kernels import multiply_rows


class PlaceIndex:
    """Exact inner-product search over the unit vectors of the mapping images.

    Args:
        vectors: (n, d) unit vectors, one a mapping image.
        node_ids: (n,) the node of each.
    """

    def __init__(self, vectors: Float32[np.ndarray, "n d"], node_ids: Int[np.ndarray, " n"]) -> None:
        self._vectors = np.ascontiguousarray(vectors)
        self._node_ids = node_ids

    def rank_nodes(self, vector: Float32[np.ndarray, " d"], num_candidates: int) -> list[NodeScore]:
        """The nodes of the nearest images, each once, with the similarity of its best image; of equal ones the earlier image's."""
        similarities = np.empty(len(self._vectors), np.float32)
        multiply_rows(self._vectors, np.ascontiguousarray(vector), similarities)
        order = np.argsort(-similarities, kind="stable")
        _, first = np.unique(self._node_ids[order], return_index=True)
        best = order[np.sort(first)[:num_candidates]]
        return [NodeScore(int(self._node_ids[row]), float(similarities[row])) for row in best]
