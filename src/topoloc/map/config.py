"""The configuration of a map: what it is built with, and what it says of itself afterwards; typed and versioned."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any

from topoloc.bounds import Between, check_bounds
from topoloc.errors import ConfigError
from topoloc.features.kinds import KINDS, FeatureConfig
from topoloc.map.landmarks import LandmarkConfig
from topoloc.map.nodes import NodeConfig
from topoloc.map.side_nodes import SideNodesConfig
from topoloc.places.stored_settings import SettingsError, bounded_settings_from, json_of
from topoloc.places.vlad import VladConfig
from topoloc.slam.metric_points import MetricPointsConfig

CONFIG_VERSION = 1
"""Of the JSON in the map file; one more whenever a key comes to mean something else."""


def descriptor_size_of(kind: str) -> int:
    """Numbers in a descriptor of this kind of features. Raises SettingsError where the kind is not known."""
    if kind not in KINDS:
        raise SettingsError(f"the feature kind {kind[:40]!r} is not known (known: {', '.join(KINDS)})")
    return KINDS[kind].descriptor_size


@dataclass(frozen=True)
class MapConfig:
    """All that decides what a map looks like; stored in the map."""

    nodes: NodeConfig = field(default_factory=NodeConfig)
    features: FeatureConfig = field(default_factory=FeatureConfig)
    points: MetricPointsConfig = field(default_factory=MetricPointsConfig)
    landmarks: LandmarkConfig = field(default_factory=LandmarkConfig)
    vlad: VladConfig = field(default_factory=VladConfig)
    sides: SideNodesConfig = field(default_factory=SideNodesConfig)
    max_node_points: Annotated[int, Between(1, 100_000)] = 800
    """Features that a node keeps, the strongest ones."""
    min_node_points: Annotated[int, Between(1, 100_000)] = 20
    """A picture with fewer located features becomes no node."""
    template_side_px: Annotated[int, Between(16, 4096)] = 240
    """Shorter side of the template picture that a node keeps, at most."""
    place_side_px: Annotated[int, Between(16, 4096)] = 160
    """Shorter side of the other mapping images, at most: what the coarse localizers of section III-B are trained with."""

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


def config_from_text(text: str) -> MapConfig:
    """The inverse of `config_to_text`. Raises SettingsError, which names the key."""
    data = json_of(text)
    if not isinstance(data, dict) or "version" not in data:
        raise SettingsError("config: key 'version' is missing")
    if data["version"] != CONFIG_VERSION:
        raise SettingsError(f"config: version {str(data['version'])[:20]!r} is not known (known: {CONFIG_VERSION})")
    return resolved_config({key: value for key, value in data.items() if key != "version"})


def resolved_config(data: Any) -> MapConfig:
    """The configuration of a map that was built, from its nested values. Raises SettingsError, which names the key."""
    config = bounded_settings_from(MapConfig, data, "config")
    for name in ("d_thresh", "lambda_rot"):
        value = getattr(config.nodes, name)
        if value is None or not 0.0 <= value < math.inf:
            raise SettingsError(f"config.nodes.{name}: a number that is not negative is expected")
    try:
        check_bounds(config, "config")
    except ConfigError as error:
        raise SettingsError(str(error)) from error
    return config
