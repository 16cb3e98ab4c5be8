"""--features: which kinds of local features a map is built of, and which it is asked by."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import replace
from typing import Annotated

import tyro

from topoloc import (
    BuildConfig,
    FeatureTypeError,
    Localizer,
    LocalizerConfig,
    MissingExtraError,
    TopoMetricMap,
    WeightsError,
)
from topoloc.apps.cli.output import UsageError
from topoloc.plugin import check_available, parse_feature_types

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


def select_build_features(config: BuildConfig, features: str | None) -> BuildConfig:
    """The configuration with the kinds of features that the option names, the first one first.

    Raises:
        UsageError: an unknown kind, or one that is named twice.
        MissingExtraError, WeightsError: what a kind that is wanted needs is not here.
    """
    kinds = config.kinds
    if features is not None:
        try:
            kinds = parse_feature_types(features)
        except FeatureTypeError as error:
            raise UsageError(str(error)) from None
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
        FeatureTypeError: the map does not hold them.
        MissingExtraError, WeightsError: what they need is not here.
    """
    localizer = Localizer(topomap, config, features=features)
    for kind, lacking in localizer.unavailable_types.items():
        print(f"warning: features {kind} of the map are not asked: {lacking}", file=sys.stderr)
    return localizer


def find_available_types(kinds: Iterable[str]) -> frozenset[str]:
    """Return those of the feature types that are available on this machine."""

    def is_available(kind: str) -> bool:
        try:
            check_available(kind)
        except (MissingExtraError, WeightsError):
            return False
        return True

    return frozenset(kind for kind in kinds if is_available(kind))
