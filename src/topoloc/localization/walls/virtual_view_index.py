"""Open the virtual views of a map for queries. They are identified by their rows."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32

from topoloc.errors import MapError
from topoloc.features.features import Features
from topoloc.localization.pose_fit import LocalMap
from topoloc.localization.walls.virtual_view_matching import with_node_id
from topoloc.mapping.coarse_models import node_ids_to_rows
from topoloc.mapping.node_cache import CachedNodes
from topoloc.mapping.topomap import TopoMetricMap, VirtualNodes
from topoloc.node_ids import Row
from topoloc.retrieval.coarse import Image
from topoloc.retrieval.vlad import SurfVlad


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
    return with_node_id(LocalMap.of_node(node), node.summary.of_node)


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
