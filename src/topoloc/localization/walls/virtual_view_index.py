"""Open the virtual views of a map for queries, and select the places that they show.

A view is identified by its row. The places lie along the trajectory, where an image in the reverse
direction may have been taken. In the reverse direction the left side shows what the mapping camera
saw on the right. So each virtual view similar to one of the image's views gives a candidate place.
It is the place from which the wall would be seen as far ahead in the other direction. Two views
that agree on a place are much stronger evidence than one door that resembles another.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from topoloc.errors import MapError
from topoloc.features.extraction import VirtualView
from topoloc.features.features import Features
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.pose_fit import LocalMap
from topoloc.mapping.coarse_models import node_ids_to_rows
from topoloc.mapping.node_cache import CachedNodes
from topoloc.mapping.topomap import TopoMetricMap, VirtualNodes
from topoloc.node_ids import Row
from topoloc.retrieval.coarse import Image
from topoloc.retrieval.vlad import SurfVlad

# minimum cosine between the viewing directions of two cameras in the same place
_MIN_DIRECTION_COSINE = 0.5


class VirtualViewIndex:
    """Hold the virtual views of a map: their ranking, poses and points.

    Row k: `rotations` and `positions` are the poses (world_from_side, metres). `centres` is the
    middle of the view's content in the world, and `middles` the same in the view's frame.

    Raises:
        MapError: the ranking of the virtual views is missing or belongs to others.
    """

    def __init__(self, topomap: TopoMetricMap, sides: VirtualNodes) -> None:
        self.coarse, self.centres = _open_ranking(sides)
        self.rotations = np.array([summary.world_from_cam.rotation for summary in sides.summaries])
        self.positions = np.array(
            [summary.world_from_cam.translation for summary in sides.summaries]
        )
        self.middles = np.einsum("nji,nj->ni", self.rotations, self.centres - self.positions)
        self.feature_config = topomap.config.feature_config_for(sides.kind)
        self.local_map = CachedNodes(lambda row: _load_local_map(sides, row))

    @property
    def axes(self) -> Float[np.ndarray, "nodes 3"]:
        """Return the viewing directions (world)."""
        return self.rotations[:, :, 2]

    def similarity(self, image: Image, features: Features) -> Float32[np.ndarray, " sides"]:
        """Return the similarity of each virtual view to a view, 0 for those that are not ranked."""
        scores = np.zeros(len(self.positions), np.float32)
        for node in self.coarse.rank(image, features, len(scores)):
            scores[node.row] = node.score
        return scores


def _load_local_map(sides: VirtualNodes, row: Row) -> LocalMap:
    node = sides.nodes[row]
    assert node.summary.of_node is not None, "a side node is one of a node"
    points = LocalMap.of_node(node)  # named after the node whose image shows them
    return replace(points, node_ids=np.full_like(points.node_ids, node.summary.of_node))


def _open_ranking(sides: VirtualNodes) -> tuple[SurfVlad, Float[np.ndarray, "nodes 3"]]:
    """Return the ranking of the virtual views, and the middles of their content (metres, world)."""
    models = [
        node_ids_to_rows(model, [summary.node_id for summary in sides.summaries])
        for model in sides.coarse_models.values()
    ]
    centres = models[0].arrays.get("centres") if len(models) == 1 else None
    if centres is None or centres.shape != (len(sides.summaries), 3):
        raise MapError("the map's side nodes come without what ranks them; build it again")
    return SurfVlad.from_model(models[0]), centres


@dataclass(frozen=True, eq=False)
class CandidatePlaces:
    """Hold the candidate places of one view of the image, row k from one virtual view of the map.

    `rotations` and `centres` are camera poses (world_from_cam, metres). `likeness` is the
    similarity of the two views.
    """

    rotations: Float[np.ndarray, "n 3 3"]
    centres: Float[np.ndarray, "n 3"]
    likeness: Float32[np.ndarray, " n"]

    @staticmethod
    def from_similarity(
        view: VirtualView, index: VirtualViewIndex, likeness: Float32[np.ndarray, " sides"]
    ) -> CandidatePlaces:
        """Return the places of all virtual views of the opposite side.

        Those of the same side belong to the mapped direction.

        Args:
            likeness: similarity of each virtual view of the map to the view.
        """
        ahead = -view.cam_from_virtual.rotation[
            0, 2
        ]  # a left camera's x axis points ahead, a right one's back
        along = index.middles[:, 0]
        rows = np.flatnonzero(ahead * along < 0.0)
        centres = index.positions[rows] + 2.0 * along[rows, None] * index.rotations[rows, :, 0]
        return CandidatePlaces(
            index.rotations[rows] @ view.cam_from_virtual.rotation.T, centres, likeness[rows]
        )

    def near(self, other: CandidatePlaces, apart: float) -> Bool[np.ndarray, "n m"]:
        """Return whether two places agree, for each pair.

        They do within `apart` metres and 60 degrees.
        """
        away = np.linalg.norm(self.centres[:, None] - other.centres[None], axis=2)
        return (away < apart) & (
            self.rotations[:, :, 2] @ other.rotations[:, :, 2].T > _MIN_DIRECTION_COSINE
        )

    def rows(self, rows: Int[np.ndarray, " m"]) -> CandidatePlaces:
        """Return the given rows."""
        return CandidatePlaces(self.rotations[rows], self.centres[rows], self.likeness[rows])


def select_likeliest_places(
    candidates: list[CandidatePlaces], num_places: int, apart: float
) -> list[Rigid3]:
    """Return the likeliest places (world_from_cam) of all views, at least `apart` metres apart.

    Each view adds the similarity of its best virtual view at the place.
    """
    chosen: list[Rigid3] = []
    if not candidates:
        return chosen
    first = [
        view.rows(np.argsort(-view.likeness, kind="stable")[:64])  # the most similar ones
        for view in candidates
    ]
    places = CandidatePlaces(
        *(
            np.concatenate([getattr(view, name) for view in first])
            for name in ("rotations", "centres", "likeness")
        )
    )
    total_similarity = np.zeros(len(places.likeness))
    for view in candidates:
        total_similarity += np.where(places.near(view, apart), view.likeness, 0.0).max(
            axis=1, initial=0.0
        )
    same, left = places.near(places, apart), np.ones(len(total_similarity), bool)
    for k in np.argsort(-total_similarity, kind="stable"):
        if len(chosen) == num_places:
            break
        if left[k]:
            chosen.append(Rigid3(places.rotations[k], places.centres[k]))
            left &= ~same[k]
    return chosen
