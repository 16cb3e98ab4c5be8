"""The walls along a map's way, opened for queries: side nodes, what ranks them, and their points. Side nodes go by their rows."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float

from topoloc.errors import MapError
from topoloc.features.side_views import SideViewConfig
from topoloc.localization.local_map import LocalMap
from topoloc.localization.wall_matching import of_picture
from topoloc.map.topomap import SideNodes, TopoMetricMap, TopoNode
from topoloc.places.vlad import SurfVlad

_NODES_IN_MEMORY = 512


class WallIndex:
    """A map's side nodes, opened: what ranks them, what they show, and their points.

    Raises:
        MapError: what ranks the side nodes is missing or not of them.
    """

    def __init__(self, topomap: TopoMetricMap, sides: SideNodes) -> None:
        self.coarse, self.centres = _ranking_of(sides)
        self.axes = np.array([summary.world_from_cam.rotation[:, 2] for summary in sides.summaries])
        self.view_config = SideViewConfig(**topomap.config["sides"]["views"])
        self._sides = sides
        ids = {(summary.recording, summary.name): summary.node_id for summary in topomap.summaries}
        self._node_ids = [ids.get((summary.recording, summary.name), 0) for summary in sides.summaries]
        self.local_map = lru_cache(maxsize=_NODES_IN_MEMORY)(self._read)

    def _read(self, row: int) -> tuple[TopoNode, LocalMap]:
        node = self._sides.nodes[row]
        return node, of_picture(LocalMap.of_node(node), self._node_ids[row])


def _ranking_of(sides: SideNodes) -> tuple[SurfVlad, Float[np.ndarray, "nodes 3"]]:
    """What names the side nodes that look most like a view, and the middles (metres, world) of what they show."""
    models = list(sides.coarse_models.values())
    centres = models[0].arrays.get("centres") if len(models) == 1 else None
    if centres is None or centres.shape != (len(sides.summaries), 3):
        raise MapError("the map's side nodes come without what ranks them; build it again")
    return SurfVlad.from_model(models[0]), centres
