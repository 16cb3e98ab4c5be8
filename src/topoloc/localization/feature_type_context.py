"""A map as it is asked by one of its kinds of features: with the settings, the fitted weights and
the shared errors of that kind."""

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
    """`config` has the kind's own thresholds where none are set; `correlated_errors` is rho of the
    map: the share of a match's variance that its points have in common (see
    `correlated_errors.py`)."""

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
        """Of a map's first kind; `weights` instead of those that ship for it. Raises as
        `OpenMap`."""
        opened = OpenMap(topomap, coarse or config.coarse)
        c, weights = config.for_feature_type(opened.kind), weights or _select_weights(opened)
        rho = find_correlated_error_share(
            topomap, c.guided, c.pose, c.correlated_errors, weights.shared_errors
        )
        return FeatureTypeContext(opened, c, weights, rho)


def _select_weights(opened: OpenMap) -> FittedWeights:
    """Those that ship; of the walls those of the kind that describes them."""
    weights, sides = load_fitted_weights(opened.kind.name), opened.topomap.sides
    if sides is None or not sides.is_used_with(opened.kind.name):
        return weights
    return replace(weights, walls=load_fitted_weights(sides.kind).walls)


def select_feature_types(
    topomap: TopoMetricMap, requested: tuple[str, ...] | None
) -> tuple[list[str], dict[str, str]]:
    """The kinds of features by which a map is asked, in turn: those that are wanted, else all whose
    networks are here. And those of the map that are left out, each with what it lacks.

    Raises:
        MissingExtraError, WeightsError: what a kind that is wanted needs is not here, or what each
            kind of the map needs.
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
