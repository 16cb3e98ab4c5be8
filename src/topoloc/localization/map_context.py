"""Open a map for the localizer: its feature types with their settings and fitted weights."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

from msgspec import structs

from topoloc.errors import WeightsError
from topoloc.features.feature_types import check_available, select_stored_types
from topoloc.geometry.camera import Camera, UncalibratedCamera
from topoloc.localization.config import LocalizerConfig
from topoloc.localization.feature_map import FeatureMap
from topoloc.localization.fitted_weights import FittedWeights, load_fitted_weights
from topoloc.localization.map_facts.correlated_errors import ErrorShareMeasurement
from topoloc.localization.provenance import Provenance
from topoloc.localization.query import Deadline, Query, QueryImage, StageClock, reduce_image
from topoloc.localization.result import NotLocalized, R
from topoloc.localization.search import Search, Trace
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.node_ids import NodeId
from topoloc.retrieval.coarse import CoarseLocalizer


@dataclass(frozen=True, eq=False)
class FeatureTypeContext:
    """Hold a map opened for one feature type.

    `config` has the type's own thresholds filled in. `correlated_errors` is the correlated error
    share (rho) of the map: the share of a match's variance that its points have in common
    (`correlated_errors.py`).
    """

    map: FeatureMap
    config: LocalizerConfig
    weights: FittedWeights
    correlated_errors: float

    @staticmethod
    def from_map(
        topomap: TopoMetricMap,
        kind: str,
        config: LocalizerConfig,
        coarse: CoarseLocalizer | None = None,
        weights: FittedWeights | None = None,
    ) -> FeatureTypeContext:
        """Open a map for a feature type.

        `weights` replaces the shipped weights. Raises the errors of `FeatureMap`.
        """
        opened = FeatureMap(topomap, coarse or config.coarse, kind)
        c, weights = config.for_feature_type(opened.kind), weights or _select_weights(opened)
        rho = ErrorShareMeasurement(topomap, kind, c.guided, c.pose, weights.shared_errors)
        return FeatureTypeContext(opened, c, weights, rho.find())


def _select_weights(opened: FeatureMap) -> FittedWeights:
    """Return the shipped weights. Those of virtual views belong to their own feature type."""
    kind = opened.kind.name
    weights, sides = load_fitted_weights(kind), opened.topomap.sides_for(kind)
    return (
        weights if sides is None else replace(weights, walls=load_fitted_weights(sides.kind).walls)
    )


@dataclass(frozen=True, eq=False)
class MapContext:
    """Hold a map that is open for queries.

    `types` holds the feature types in use, in order of their searches. `unavailable_types` maps
    each feature type of the map that cannot be used to the reason.
    """

    topomap: TopoMetricMap
    config: LocalizerConfig
    types: tuple[FeatureTypeContext, ...]
    unavailable_types: dict[str, str]

    @staticmethod
    def from_map(
        topomap: TopoMetricMap,
        config: LocalizerConfig,
        coarse: CoarseLocalizer | None = None,
        weights: FittedWeights | None = None,
        features: str | None = None,
    ) -> MapContext:
        """Open a map for queries. The arguments and errors are those of `Localizer`. Raises
        MapError: a tolerance in metres is given, and the map has no scale."""
        if not topomap.config.has_scale:
            if config.evidence.tolerance is not None:
                topomap.require_scale("--tolerance")
            config = replace(config, evidence=replace(config.evidence, is_relative=True))
        requested = config.kinds
        if features is not None:
            requested = select_stored_types(topomap.kinds, features)
        kinds, unavailable_types = select_feature_types(topomap, requested)
        types = tuple(
            FeatureTypeContext.from_map(
                topomap, kind, config, coarse, weights if kind == kinds[0] else None
            )
            for kind in kinds
        )
        return MapContext(topomap, config, types, unavailable_types)

    @cached_property
    def map_id(self) -> str:
        """Return the map's id, 16 hexadecimal digits."""
        return self.topomap.id

    @property
    def first(self) -> FeatureTypeContext:
        """Return the feature type of the first search."""
        return self.types[0]

    def without(self, node_ids: Iterable[NodeId]) -> MapContext:
        """Return the map without these nodes. See `Localizer.without`."""
        rows = self.topomap.rows_of(node_ids)
        types = tuple(replace(one, map=one.map.without(rows)) for one in self.types)
        return replace(self, types=types)

    def searches(
        self,
        query_image: QueryImage,
        clock: StageClock,
        deadline: Deadline,
        trace: Trace | None = None,
    ) -> list[Search]:
        """Return one search for each feature type. Each one links to the previous one.

        No further hypothesis is tested after the deadline.
        """
        config, opened, searches = self.config, self.first.map, list[Search]()
        reduced, camera = reduce_image(
            query_image.image,
            query_image.camera,
            opened.focal,
            config.max_finer,
            config.max_side_px,
        )
        scale = query_image.image.shape[1] / camera.width
        for one in self.types:
            query = Query(
                reduced,
                camera,
                scale,
                one.map.feature_config,
                clock,
                deadline,
                query_image.features,
            )
            search = Search(query, one.map, one.config, one.weights, one.correlated_errors, trace)
            if searches:
                search.previous, searches[-1].is_last = searches[-1], False
            searches.append(search)
        return searches

    def with_provenance(
        self, result: R, camera: Camera | UncalibratedCamera | None = None, t_ns: int | None = None
    ) -> R:
        """Return the result with the map's identity, its geopose, the camera and the time
        (nanoseconds)."""
        found = result.provenance.camera  # estimated with the pose
        if found is not None and camera is not None:
            camera = found.rescaled(camera.width, camera.height)
        elif isinstance(camera, UncalibratedCamera):
            camera = None
        provenance = Provenance(
            self.map_id,
            self.topomap.version,
            result.provenance.features,
            t_ns=t_ns,
            camera=camera,
            has_scale=self.topomap.config.has_scale,
        )
        georeference = self.topomap.georeference
        if isinstance(result, NotLocalized):
            alternatives = result.alternatives
            if georeference:
                alternatives = tuple(
                    structs.replace(one, geopose=georeference.geopose(one.world_from_cam))
                    for one in alternatives
                )
            return replace(result, provenance=provenance, alternatives=alternatives)
        return replace(
            result,
            provenance=provenance,
            geopose=georeference.geopose(result.world_from_cam) if georeference else None,
        )


def select_feature_types(
    topomap: TopoMetricMap, requested: tuple[str, ...] | None
) -> tuple[list[str], dict[str, str]]:
    """Select the feature types to use, in order: the requested ones, or all available ones.

    Returns:
        The available types, and the unavailable types of the map with the reason for each.

    Raises:
        WeightsError: a requested type is not available, or no type of the map is.
    """
    available, unavailable_types, first = list[str](), dict[str, str](), None
    for kind in requested or topomap.kinds:
        try:
            check_available(kind)
            available.append(kind)
        except WeightsError as error:
            if requested:
                raise
            first, unavailable_types[kind] = first or error, str(error)
    if first is not None and not available:
        raise first
    return available, unavailable_types
