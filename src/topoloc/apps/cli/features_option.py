"""--features: which kinds of local features a map is built of, and which it is asked by."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Annotated

import tyro

from topoloc import FeatureTypeError, Localizer, LocalizerConfig, TopoMetricMap
from topoloc.apps.cli.output import UsageError
from topoloc.features.feature_types import (
    FEATURE_TYPES,
    SURF,
    check_available,
    default_learned_type,
)
from topoloc.mapping.config import MapConfig

BUILD_FEATURES = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="surf|sift|learned|both|KIND[,KIND]",
        help_behavior_hint="(default: both where a network is here)",
    ),
]
QUERY_FEATURES = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="surf|learned|both|KIND[,KIND]",
        help_behavior_hint="(default: all that the map holds)",
    ),
]


def select_build_features(config: MapConfig, features: str | None) -> MapConfig:
    """The configuration with the kinds of features that the option names, the first one first.

    Raises:
        UsageError: an unknown kind, or one that is named twice.
        MissingExtraError, WeightsError: what a kind that is wanted needs is not here.
    """
    if features is None:
        kinds = config.kinds
    elif features == "both":
        kinds = [SURF.name, default_learned_type()]
    else:
        kinds = [default_learned_type()] if features == "learned" else features.split(",")
        config = replace(config, other_kinds=())
    if unknown := [kind for kind in kinds if kind not in FEATURE_TYPES]:
        raise UsageError(f"no features {unknown[0]!r}; there are {', '.join(FEATURE_TYPES)}")
    if len(set(kinds)) < len(kinds):
        raise UsageError(f"--features {features}: a kind is named twice")
    for kind in kinds:
        check_available(kind)
    return replace(
        config, features=replace(config.features, kind=kinds[0]), other_kinds=tuple(kinds[1:])
    )


def create_localizer(
    topomap: TopoMetricMap, config: LocalizerConfig, features: str | None
) -> Localizer:
    """Asks the map by the kinds of features that the option names; one line on standard error for
    each of the map's that cannot be asked.

    Raises:
        FeatureKindError: the map does not hold them.
        MissingExtraError, WeightsError: what they need is not here.
    """
    localizer = Localizer(topomap, _with_feature_types(topomap, config, features))
    for kind, lacking in localizer.unavailable_types.items():
        print(f"warning: features {kind} of the map are not asked: {lacking}", file=sys.stderr)
    return localizer


def _with_feature_types(
    topomap: TopoMetricMap, config: LocalizerConfig, features: str | None
) -> LocalizerConfig:
    if features is None:
        return config
    if features == "both":
        return replace(config, kinds=tuple(topomap.kinds))
    named = features.split(",")
    kinds = [
        kind
        for kind in topomap.kinds
        if kind in named or (features == "learned" and FEATURE_TYPES[kind].network is not None)
    ]
    missing = [name for name in named if name not in kinds] if features != "learned" else []
    if missing or not kinds:
        raise FeatureTypeError(
            f"the map holds no features {(missing or [features])[0]} (it holds:"
            f" {', '.join(topomap.kinds)})"
        )
    return replace(config, kinds=tuple(kinds))
