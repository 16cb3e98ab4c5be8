"""Localizing a single image in the topo-metric map: section III-B of the paper, read from the top.

The coarse localizer names the nodes that the image may belong to; the image is patch-normalised and its features are
matched with those of the nodes; PnP on the matches gives the camera's global pose. Unlike the paper's blind first choice,
several candidate nodes pool their points (`num_candidates=1` gives the paper's behaviour), and a pose is reported only
where the evidence for it could not have come about by chance.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import UInt8

from topoloc.errors import EmptyMapError, MapError, QueryError
from topoloc.features.extraction import FeatureConfig, extract_features
from topoloc.features.features import Features, Matches
from topoloc.features.matching import MatchingConfig, match_pooled
from topoloc.geometry.absolute_pose import AbsolutePose, AbsolutePoseConfig, covariance_of_inverse, estimate_absolute_pose
from topoloc.geometry.camera import Camera
from topoloc.localization.local_map import LocalMap
from topoloc.localization.result import Localization, NotLocalized
from topoloc.localization.stages import StageClock
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.places.coarse import Image, NodeScore, open_coarse

NODES_IN_MEMORY = 256


@dataclass(frozen=True)
class LocalizerConfig:
    """How a query is answered. The features are those that the map was built with."""

    coarse: str = "surf-vlad"
    """Which of the map's coarse localizers is asked."""
    num_candidates: int = 5
    """Nodes whose points are pooled; 1 is the paper's single node."""
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    pose: AbsolutePoseConfig = field(default_factory=AbsolutePoseConfig)
    min_matches: int = 8
    min_inliers: int = 12


class Localizer:
    """Holds an open map, its coarse localizer and the nodes used lately.

    Raises:
        EmptyMapError: the map has no node.
        MapError: the map has no such coarse localizer.
    """

    def __init__(self, topomap: TopoMetricMap, config: LocalizerConfig | None = None) -> None:
        self.config = config or LocalizerConfig()
        self.topomap = topomap
        if len(topomap.summaries) == 0:
            raise EmptyMapError("the map has no nodes")
        if self.config.coarse not in topomap.coarse_models:
            available = ", ".join(topomap.coarse_models) or "none"
            raise MapError(f"the map has no coarse localizer {self.config.coarse!r} (it has: {available})")
        self._coarse = open_coarse(topomap.coarse_models[self.config.coarse])
        self._feature_config = FeatureConfig(**topomap.config["features"])
        self._local_maps: OrderedDict[int, LocalMap] = OrderedDict()

    def localize(self, image: Image, camera: Camera) -> Localization | NotLocalized:
        """Where was this image (grey or RGB, uint8) taken, by a camera of this calibration?

        Raises:
            QueryError: the camera is of another image size.
        """
        height, width = image.shape[:2]
        if (camera.width, camera.height) != (width, height):
            raise QueryError(f"the image is {width}x{height}, its camera {camera.width}x{camera.height}")
        clock = StageClock()
        features = self._extract(image, clock)
        candidates = self._rank_nodes(image, features, clock)
        local_map, matches = self._match(features, candidates, clock)
        if len(matches) < self.config.min_matches:
            return NotLocalized("too_few_matches", candidates, len(matches), 0, clock.times_ms())
        pose = self._estimate_pose(features, local_map, matches, camera, clock)
        num_inliers = int(pose.inliers.sum()) if pose else 0
        if pose is None or num_inliers < self.config.min_inliers:
            return NotLocalized("too_few_inliers", candidates, len(matches), num_inliers, clock.times_ms())
        node_id = int(np.bincount(local_map.node_ids[matches.train_idx[pose.inliers]]).argmax())
        return Localization(
            world_from_cam=pose.cam_from_world.inverse(),
            covariance=covariance_of_inverse(pose.cam_from_world, pose.covariance),
            probability=1.0,
            node_id=node_id,
            candidates=candidates,
            num_matches=len(matches),
            num_inliers=num_inliers,
            times_ms=clock.times_ms(),
        )

    def _extract(self, image: Image, clock: StageClock) -> Features:
        with clock.stage("features"):
            return extract_features(_grey(image), self._feature_config)

    def _rank_nodes(self, image: Image, features: Features, clock: StageClock) -> list[NodeScore]:
        with clock.stage("coarse"):
            return self._coarse.rank(image, features, self.config.num_candidates)

    def _match(self, features: Features, candidates: list[NodeScore], clock: StageClock) -> tuple[LocalMap, Matches]:
        with clock.stage("matching"):
            local_map = LocalMap.pooled([self._local_map(c.node_id) for c in candidates])
            matches = match_pooled(
                features.descriptors, local_map.descriptors, local_map.points_world, local_map.radii, self.config.matching
            )
            return local_map, matches

    def _estimate_pose(
        self, features: Features, local_map: LocalMap, matches: Matches, camera: Camera, clock: StageClock
    ) -> AbsolutePose | None:
        with clock.stage("pnp"):
            return estimate_absolute_pose(
                features.points_img[matches.query_idx].astype(np.float64),
                local_map.points_world[matches.train_idx],
                camera,
                self.config.pose,
                point_covariances=local_map.covariances[matches.train_idx],
                priorities=-matches.distances.astype(np.float64),
            )

    def _local_map(self, node_id: int) -> LocalMap:
        if node_id not in self._local_maps:
            self._local_maps[node_id] = LocalMap.of_node(self.topomap.nodes[node_id])
            if len(self._local_maps) > NODES_IN_MEMORY:
                self._local_maps.popitem(last=False)
        self._local_maps.move_to_end(node_id)
        return self._local_maps[node_id]


def _grey(image: Image) -> UInt8[np.ndarray, "h w"]:
    from topoloc.mapping.views import grey_of

    return grey_of(image)
