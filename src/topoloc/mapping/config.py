"""Define the settings of a map, which are stored in it. They are typed and versioned."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any, Protocol, runtime_checkable

from topoloc.bounds import AtLeast, Between, drop_removed_settings, parse_settings
from topoloc.errors import ConfigError
from topoloc.features.feature_types import (
    SURF,
    FeatureConfig,
    check_available,
    default_learned_type,
    find_feature_type,
    parse_feature_types,
)
from topoloc.json_data import OneLine, decode_json
from topoloc.mapping.nodes import NodeConfig
from topoloc.mapping.validation import CorruptDataError
from topoloc.retrieval.coarse import VladConfig

CONFIG_VERSION = 1
"""Version of the JSON in the map file. It increases if the meaning of a key changes."""


@runtime_checkable
class Progress(Protocol):
    """A callable with a stage's name, steps done and steps in all."""

    def __call__(self, stage: str, done: int, total: int, /) -> None:
        """Report progress."""
        ...


@dataclass(frozen=True)
class VirtualNodesConfig:
    """Configure which nodes have virtual nodes."""

    spacing: Annotated[float, AtLeast(0)] = 3.0
    """Nodes are selected by Eq. 1 with this many times the map's D_thresh and half the weight of
    rotation. 0 creates no virtual nodes."""


@dataclass(frozen=True, repr=False)
class MapConfig(OneLine):
    """Configure how a map is built. The settings are stored in the map."""

    nodes: NodeConfig = field(default_factory=NodeConfig)
    features: FeatureConfig = field(default_factory=FeatureConfig)
    other_kinds: tuple[str, ...] | None = None
    """Further feature types of the same nodes. A query uses them if the first type leaves its pose
    uncertain. None: beside SURF, the default learned type."""
    vlad: VladConfig = field(default_factory=VladConfig)
    sides: VirtualNodesConfig = field(default_factory=VirtualNodesConfig)
    look_alike_floors: bool = False
    """The building has other floors like this one that the map does not hold. A pose is then given
    only if the colours agree."""
    scale_sigma: Annotated[float | None, Between(0, 1)] = 0.0
    """Relative standard deviation of all lengths of the map, such as those of photos whose scale is
    that of a printed tag. None: the scale is unknown, and lengths are in units of the map."""

    @property
    def kinds(self) -> list[str]:
        """Return all feature types, the first type first."""
        if self.other_kinds is not None or self.features.kind != SURF.name:
            return [self.features.kind, *(self.other_kinds or ())]
        return [self.features.kind, default_learned_type()]

    @property
    def virtual_view_type(self) -> str:
        """Return the feature type of virtual nodes. It follows from the first learned type, or from
        the first type if none is learned."""
        kinds = [find_feature_type(kind) for kind in self.kinds]
        return next((one for one in kinds if one.network is not None), kinds[0]).virtual_view_type

    def with_kinds(self, text: str | None) -> MapConfig:
        """Return the settings with the feature types that a text names (`parse_feature_types`), or
        with the same ones.

        Raises:
            FeatureTypeError: one is unknown, or is named twice.
            WeightsError: one is not available on this machine.
        """
        first, *others = kinds = self.kinds if text is None else parse_feature_types(text)
        for kind in kinds:
            check_available(kind)
        return replace(self, features=replace(self.features, kind=first), other_kinds=tuple(others))

    def feature_config_for(self, kind: str) -> FeatureConfig:
        """Return the feature settings of a type. Other types than the first use their own default
        normalization."""
        if kind == self.features.kind:
            return self.features
        return replace(self.features, kind=kind, normalization=None)

    def vlad_config_for(self, kind: str) -> VladConfig:
        """Return the settings of surf-vlad for a feature type."""
        if self.vlad.position_weight is not None:
            return self.vlad
        return replace(self.vlad, position_weight=find_feature_type(kind).position_weight)

    @property
    def has_scale(self) -> bool:
        """Return whether lengths are metres."""
        return self.scale_sigma is not None

    @property
    def d_thresh(self) -> float:
        """Return D_thresh of Eq. 1 in metres. It must be resolved, as in any built map."""
        return _resolved(self.nodes.d_thresh)

    @property
    def lambda_rot(self) -> float:
        """Return lambda of Eq. 1 in metres per radian."""
        return _resolved(self.nodes.lambda_rot)

    def to_json(self) -> dict[str, Any]:
        """Return the settings and their version as JSON."""
        settings = asdict(self)
        if self.scale_sigma == 0.0:  # earlier versions do not know it
            del settings["scale_sigma"]
        return {"version": CONFIG_VERSION, **settings}


def _resolved(value: float | None) -> float:
    if value is None:
        raise ValueError("the configuration of a map that is not built yet")
    return value


def config_from_text(text: str, version: int | None) -> MapConfig:
    """Parse the JSON of `MapConfig.to_json`. Files of schema 1 contain no version. Raises
    ConfigError with the key."""
    data = decode_json(text, dict[str, Any], CorruptDataError, "config")
    if version is not None and data.pop("version", None) != version:
        raise ConfigError(f"config: of another version than {version}, which is known")
    config = parse_settings(MapConfig, drop_removed_settings(data, "build"), "config")
    for name in ("d_thresh", "lambda_rot"):
        if getattr(config.nodes, name) is None:
            raise ConfigError(f"config.nodes.{name}: is missing")
    return config
