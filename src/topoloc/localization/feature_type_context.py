"""Combine a map with the settings, fitted weights and correlated errors of one feature type."""

from __future__ import annotations

from dataclasses import dataclass, replace

from topoloc.errors import MissingExtraError, WeightsError
from topoloc.features.feature_types import check_available
from topoloc.localization.config import LocalizerConfig
from topoloc.localization.fitted_weights import FittedWeights, load_fitted_weights
from topoloc.localization.map_facts.correlated_errors import find_correlated_error_share
from topoloc.localization.open_map import OpenMap
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.retrieval.coarse import CoarseLocalizer


@dataclass(frozen=True, eq=False)
class FeatureTypeContext:
    """Hold a map opened for one feature type.

    `config` has the type's own thresholds filled in. `correlated_errors` is the correlated error
    share (rho) of the map: the share of a match's variance that its points have in common
    (`correlated_errors.py`).
    """

    map: OpenMap
    config: LocalizerConfig
    weights: FittedWeights
    correlated_errors: float

    @staticmethod
    def of(
        topomap: TopoMetricMap,
        config: LocalizerConfig,
        coarse: CoarseLocalizer | None = None,
        weights: FittedWeights | None = None,
    ) -> FeatureTypeContext:
        """Open a map for its first feature type.

        `weights` replaces the shipped weights. Raises the errors of `OpenMap`.
        """
        opened = OpenMap(topomap, coarse or config.coarse)
        c, weights = config.for_feature_type(opened.kind), weights or _select_weights(opened)
        rho = find_correlated_error_share(
            topomap, c.guided, c.pose, c.correlated_errors, weights.shared_errors
        )
        return FeatureTypeContext(opened, c, weights, rho)


def _select_weights(opened: OpenMap) -> FittedWeights:
    """Return the shipped weights. Those of virtual views belong to their own feature type."""
    weights, sides = load_fitted_weights(opened.kind.name), opened.topomap.sides
    if sides is None or not sides.is_used_with(opened.kind.name):
        return weights
    return replace(weights, walls=load_fitted_weights(sides.kind).walls)


def select_feature_types(
    topomap: TopoMetricMap, requested: tuple[str, ...] | None
) -> tuple[list[str], dict[str, str]]:
    """Select the feature types to use, in order: the requested ones, or all available ones.

    Returns:
        The available types, and the unavailable types of the map with the reason for each.

    Raises:
        MissingExtraError, WeightsError: a requested type is not available, or no type of the map
            is.
    """
    available, unavailable_types, first = list[str](), dict[str, str](), None
    for kind in requested or topomap.kinds:
        try:
            check_available(kind)
            available.append(kind)
        except (MissingExtraError, WeightsError) as error:
            if requested:
                raise
            first, unavailable_types[kind] = first or error, str(error)
    if first is not None and not available:
        raise first
    return available, unavailable_types
