"""Matches between images and single nodes of a map, outside the search for a pose."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from topoloc.features.extraction import extract_features
from topoloc.features.feature_types import FeatureConfig, find_feature_type
from topoloc.features.features import Features, MatchingConfig
from topoloc.features.matching import Matches, match_pooled
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.guided import GuidedConfig, match_guided
from topoloc.localization.pose_fit import LocalMap
from topoloc.mapping.storage.entries import TopoNode
from topoloc.recordings.frame import Image, to_grey


@dataclass(frozen=True, eq=False)
class NodeMatcher:
    """Match images with the points of one node; row k of the arrays is feature k of the node.

    `config` is the feature configuration of the node's map (`topomap.config.features`).
    """

    node: TopoNode
    config: FeatureConfig

    @property
    def points_world(self) -> Float[np.ndarray, "n 3"]:
        """The node's points in the world, metres."""
        return self._local_map.points_world

    @property
    def covariances(self) -> Float[np.ndarray, "n 3 3"]:
        """Their covariances, axes of the world, square metres."""
        return self._local_map.covariances

    def extract_features(self, image: Image) -> Features:
        """Return the features of an image (uint8, grey or RGB) as the map's were extracted.

        Raises:
            FeatureTypeError: the feature type of the map does not exist here.
        """
        return extract_features(to_grey(image), self.config)

    def match(self, features: Features) -> Matches:
        """Match features with the node by appearance alone, as no pose is known."""
        points, kind = self._local_map, find_feature_type(self.config.kind)
        return match_pooled(
            features.descriptors,
            points.descriptors,
            points.points_world,
            points.radii,
            MatchingConfig(ratio=kind.ratio),
        )

    def match_at_pose(
        self,
        features: Features,
        cam_from_world: Rigid3,
        camera: Camera,
        radius_px: float | None = None,
    ) -> Matches:
        """Match features of an image of `camera` with the node's points, each near its projection.

        Args:
            radius_px: how near, in an image whose longer side is 640 pixels. Default: as in a
                localization.
        """
        config = GuidedConfig() if radius_px is None else GuidedConfig(radius_px=radius_px)
        resolved = config.resolved(find_feature_type(self.config.kind))
        return match_guided(features, self._local_map, cam_from_world, camera, resolved)

    @cached_property
    def _local_map(self) -> LocalMap:
        return LocalMap.of_node(self.node)
