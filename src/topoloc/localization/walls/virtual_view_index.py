"""The walls along a map's way, opened for queries: side nodes, what ranks them, and their points.
Side nodes go by their rows."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32

from topoloc.errors import MapError
from topoloc.features.features import Features
from topoloc.localization.local_map import LocalMap
from topoloc.localization.walls.virtual_view_matching import with_node_id
from topoloc.mapping.node_cache import CachedNodes
from topoloc.mapping.topomap import TopoMetricMap, VirtualNodes, node_ids_to_rows
from topoloc.retrieval.coarse import Image
from topoloc.retrieval.vlad import SurfVlad


class VirtualViewIndex:
    """A map's side nodes, opened: what ranks them, where they are, and their points.

    Row k: `rotations` and `positions` are the poses (world_from_side, metres), `centres` the middle
    of what is shown in the world and `middles` the same in the side camera's frame.

    Raises:
        MapError: what ranks the side nodes is missing or not of them.
    """

    def __init__(self, topomap: TopoMetricMap, sides: VirtualNodes) -> None:
        self.coarse, self.centres = _open_ranking(sides)
        self.rotations = np.array([summary.world_from_cam.rotation for summary in sides.summaries])
        self.positions = np.array(
            [summary.world_from_cam.translation for summary in sides.summaries]
        )
        self.middles = np.einsum("nji,nj->ni", self.rotations, self.centres - self.positions)
        self.view_config, self.feature_config = (
            topomap.config.sides.views,
            topomap.config.feature_config_for(sides.kind),
        )
        self.local_map = CachedNodes(lambda row: _load_local_map(sides, row))

    @property
    def axes(self) -> Float[np.ndarray, "nodes 3"]:
        """The ways in which the side nodes look."""
        return self.rotations[:, :, 2]

    def similarity(self, image: Image, features: Features) -> Float32[np.ndarray, " sides"]:
        """How much each side node looks like a view; 0 where it is not among those compared."""
        scores = np.zeros(len(self.positions), np.float32)
        for node in self.coarse.rank(image, features, len(scores)):
            scores[node.node_id] = node.score
        return scores


def _load_local_map(sides: VirtualNodes, row: int) -> LocalMap:
    node = sides.nodes[row]
    assert node.summary.of_node is not None, "a side node is one of a node"
    return with_node_id(LocalMap.of_node(node), node.summary.of_node)


def _open_ranking(sides: VirtualNodes) -> tuple[SurfVlad, Float[np.ndarray, "nodes 3"]]:
    """What names the side nodes that look most like a view, and the middles (metres, world) of what
    they show."""
    models = [
        node_ids_to_rows(model, [summary.node_id for summary in sides.summaries])
        for model in sides.coarse_models.values()
    ]
    centres = models[0].arrays.get("centres") if len(models) == 1 else None
    if centres is None or centres.shape != (len(sides.summaries), 3):
        raise MapError("the map's side nodes come without what ranks them; build it again")
    return SurfVlad.from_model(models[0]), centres
