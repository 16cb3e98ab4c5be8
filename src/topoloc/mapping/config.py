"""The configuration of a map: what it is built with, and what it says of itself afterwards; typed
and versioned."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any

from topoloc.bounds import Between, parse_settings
from topoloc.errors import ConfigError, MissingExtraError, WeightsError
from topoloc.features.feature_types import (
    SURF,
    FeatureConfig,
    default_learned_type,
    find_feature_type,
)
from topoloc.mapping.landmarks import LandmarkConfig
from topoloc.mapping.nodes import NodeConfig
from topoloc.mapping.validation import parse_json
from topoloc.mapping.virtual_nodes import VirtualNodesConfig
from topoloc.points.metric_points import MetricPointsConfig
from topoloc.points.motion_triangulation import MotionTriangulationConfig
from topoloc.retrieval.vlad import VladConfig

CONFIG_VERSION = 1
"""Of the JSON in the map file; one more whenever a key comes to mean something else."""


@dataclass(frozen=True)
class MapConfig:
    """All that decides what a map looks like; stored in the map."""

    nodes: NodeConfig = field(default_factory=NodeConfig)
    features: FeatureConfig = field(default_factory=FeatureConfig)
    other_kinds: tuple[str, ...] | None = None
    """Further kinds of features that the same nodes are described with: a query asks them where the
    first one leaves its pose unclear. Unset: beside SURF the learned ones whose network is here, if
    any is."""
    points: MetricPointsConfig = field(default_factory=MetricPointsConfig)
    motion: MotionTriangulationConfig = field(default_factory=MotionTriangulationConfig)
    landmarks: LandmarkConfig = field(default_factory=LandmarkConfig)
    vlad: VladConfig = field(default_factory=VladConfig)
    sides: VirtualNodesConfig = field(default_factory=VirtualNodesConfig)
    max_node_points: Annotated[int, Between(1, 100_000)] = 800
    """Features that a node keeps, the strongest ones."""
    min_node_points: Annotated[int, Between(1, 100_000)] = 20
    """A picture with fewer located features becomes no node."""
    template_side_px: Annotated[int, Between(16, 4096)] = 240
    """Shorter side of the template picture that a node keeps, at most."""
    place_side_px: Annotated[int, Between(16, 4096)] = 160
    """Shorter side of the other mapping images, at most: what the coarse localizers of section
    III-B are trained with."""

    @property
    def kinds(self) -> list[str]:
        """All kinds of features, the first one first."""
        if self.other_kinds is not None or self.features.kind != SURF.name:
            return [self.features.kind, *(self.other_kinds or ())]
        try:
            return [self.features.kind, default_learned_type()]
        except (MissingExtraError, WeightsError):
            return [self.features.kind]

    @property
    def virtual_view_type(self) -> str:
        """The kind of features that side nodes are described with: that of a kind that a network
        gives, where the map has one."""
        kinds = [find_feature_type(kind) for kind in self.kinds]
        return next(
            (kind for kind in kinds if kind.network is not None), kinds[0]
        ).virtual_view_type

    def feature_config_for(self, kind: str) -> FeatureConfig:
        """The settings of the features of this kind: those of `features`, but for the picture's
        normalization, which suits the kind."""
        return (
            self.features
            if kind == self.features.kind
            else replace(self.features, kind=kind, normalization=None)
        )

    def vlad_config_for(self, kind: str) -> VladConfig:
        """The settings of surf-vlad by features of this kind."""
        weight = self.vlad.position_weight
        return replace(
            self.vlad,
            position_weight=find_feature_type(kind).position_weight if weight is None else weight,
        )

    @property
    def d_thresh(self) -> float:
        """D_thresh of Eq. 1, metres; of a map that is built it is known."""
        assert self.nodes.d_thresh is not None, "the configuration of a map that is not built yet"
        return self.nodes.d_thresh

    @property
    def lambda_rot(self) -> float:
        """lambda of Eq. 1, metres a radian."""
        assert self.nodes.lambda_rot is not None, "the configuration of a map that is not built yet"
        return self.nodes.lambda_rot

    def to_json(self) -> dict[str, Any]:
        return {"version": CONFIG_VERSION, **asdict(self)}


def config_to_text(config: MapConfig) -> str:
    """The JSON that the map file keeps."""
    return json.dumps(config.to_json(), sort_keys=True)


def config_from_text(text: str, version: int | None) -> MapConfig:
    """The inverse of `config_to_text`; files of schema 1 named no version. Raises ConfigError,
    which names the key."""
    data = parse_json(text)
    if version is not None and isinstance(data, dict) and data.pop("version", None) != version:
        raise ConfigError(f"config: of another version than {version}, which is known")
    config = parse_settings(MapConfig, data, "config")
    for name in ("d_thresh", "lambda_rot"):
        if getattr(config.nodes, name) is None:
            raise ConfigError(f"config.nodes.{name}: is missing")
    return config
