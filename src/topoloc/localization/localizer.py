"""Localize a single image in the topo-metric map (section III-B of the paper).

The coarse localizer ranks candidate nodes. The image is patch-normalised and its features are
matched with those of the nodes. PnP on the matches gives the camera's global pose.

The paper keeps the first pose without a check. This localizer runs one loop over pose hypotheses
(`query_session.py`) instead. Pose proposals are generated cheapest and likeliest first
(`propose.py`). Each one is refined and its evidence counted in the same way (`refine.py`). It then
enters the belief over hypotheses (`belief.py`), until the result is settled. A pose is reported
only if its evidence is strong and no other place in the map explains the image as well.

These settings give the paper's own behaviour: `num_candidates=1`, `guided.num_nodes=0`,
`look_alikes.max_groups=0`, `viewpoints.num_nodes=0`, `walls.num_places=0`.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Iterable
from dataclasses import replace
from typing import TypeVar

from topoloc.bounds import check_bounds
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.geometry.uncalibrated_camera import UncalibratedCamera
from topoloc.localization.config import LocalizerConfig
from topoloc.localization.feature_type_context import FeatureTypeContext, select_feature_types
from topoloc.localization.fitted_weights import FittedWeights
from topoloc.localization.provenance import Provenance
from topoloc.localization.query import Query, QueryImage, reduce_image, unknown_camera
from topoloc.localization.query_session import QuerySession
from topoloc.localization.result import Localization, NotLocalized, with_time
from topoloc.localization.result_decision import ResultWithInliers
from topoloc.localization.search import Search, Trace
from topoloc.mapping.contents import get_map_id
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.retrieval.coarse import CoarseLocalizer, Image

__all__ = ["Localizer", "LocalizerConfig"]

R = TypeVar("R", bound=Localization | NotLocalized)


class Localizer:
    """Hold an open map, its coarse localizer and a cache of recently used nodes.

    `unavailable_types` maps each feature type of the map that cannot be used to the reason. A type
    cannot be used if its network or ONNX Runtime is not installed.

    Args:
        coarse: ranks the candidate nodes instead of one of the map's own coarse localizers. Any
            object with `CoarseLocalizer.rank` (`topoloc/retrieval/coarse.py`) works, such as
            another retrieval method or an external prior. `config.coarse` is then ignored.
        weights: fitted weights to use instead of those shipped for the map's first feature type.

    Raises:
        ConfigError: a setting is out of bounds.
        FeatureTypeError: the map's feature type is unknown.
        EmptyMapError: the map has no node.
        MapError: the map has no such coarse localizer.
        MissingExtraError, WeightsError: a feature network is not installed, and the map has no
            other feature type or `config.kinds` names this one.
    """

    def __init__(
        self,
        topomap: TopoMetricMap,
        config: LocalizerConfig | None = None,
        coarse: CoarseLocalizer | None = None,
        weights: FittedWeights | None = None,
    ) -> None:
        config = config or LocalizerConfig()
        check_bounds(config)
        self.topomap, self.map_id = topomap, get_map_id(topomap)
        kinds, self.unavailable_types = select_feature_types(topomap, config.kinds)
        self._kinds = [
            FeatureTypeContext.of(
                topomap.with_feature_type(kind),
                config,
                coarse,
                weights if kind == kinds[0] else None,
            )
            for kind in kinds
        ]
        self.map, self.config, self.weights = (
            self._kinds[0].map,
            self._kinds[0].config,
            self._kinds[0].weights,
        )

    def localize(
        self,
        image: Image,
        camera: Camera | UncalibratedCamera | None,
        prior: Rigid3 | None = None,
        max_ms: float | None = None,
        trace: Trace | None = None,
        t_ns: int | None = None,
    ) -> Localization | NotLocalized:
        """Estimate the pose of an image (grey or RGB, uint8).

        If the camera is only approximately known, or unknown (None), the focal length is estimated
        with the pose. This takes a few times as long and assumes a pinhole camera.

        Args:
            camera: camera model of the image, exact or approximate. None: unknown.
            prior: approximate pose (world_from_cam). The nodes nearest to it replace coarse
                retrieval. The pose needs the same evidence as any other, from matches that the
                prior did not guide.
            max_ms: time limit in milliseconds, instead of `config.max_ms`. No further hypothesis is
                tested after it.
            trace: collects all tried proposals.
            t_ns: capture time in nanoseconds, stored in the result.

        Raises:
            QueryError: the image is not an 8-bit image, or its size differs from the camera's.
        """
        result = self.localize_with_inliers(
            image, camera or unknown_camera(image), prior, max_ms, trace
        )[0]
        return result if t_ns is None else with_time(result, t_ns)

    def localize_with_inliers(
        self,
        image: Image,
        camera: Camera | UncalibratedCamera,
        prior: Rigid3 | None,
        max_ms: float | None = None,
        trace: Trace | None = None,
    ) -> ResultWithInliers:
        """Localize as `localize` does, and also return the inliers of each reported pose.

        The reported poses are the result's own pose, or its alternatives.
        """
        return self.localize_query(QueryImage(image, camera), prior, max_ms, trace)

    def localize_query(
        self,
        query_image: QueryImage,
        prior: Rigid3 | None = None,
        max_ms: float | None = None,
        trace: Trace | None = None,
    ) -> ResultWithInliers:
        """Localize as `localize_with_inliers` does, with a query image that caches its features.

        Several maps can share these features.
        """
        return self.query_session(query_image, prior, max_ms, trace).localize_exhaustive()

    def query_session(
        self,
        query_image: QueryImage,
        prior: Rigid3 | None = None,
        max_ms: float | None = None,
        trace: Trace | None = None,
    ) -> QuerySession:
        """Return a session for this query, which can run a coarse pass before the exhaustive
        one."""
        searches, camera = (
            self._searches(self._query(query_image, max_ms), trace),
            query_image.camera,
        )

        def with_provenance(outcome: ResultWithInliers) -> ResultWithInliers:
            return self.with_provenance(outcome[0], camera), [
                (self.with_provenance(one, camera), seen) for one, seen in outcome[1]
            ]

        return QuerySession(searches, prior, with_provenance)

    def without(self, node_ids: Iterable[int]) -> Localizer:
        """Return a localizer for the same map without these nodes.

        An image recorded at one of them is then localized in the rest of the map. At least one node
        must remain. Virtual views are not used.

        Raises:
            KeyError: the map has no node with such an id.
        """
        rows, other = [self.topomap.row_of(node_id) for node_id in node_ids], copy.copy(self)
        other._kinds = [replace(kind, map=kind.map.without(rows)) for kind in self._kinds]
        other.map = other._kinds[0].map
        return other

    def with_provenance(
        self, result: R, camera: Camera | UncalibratedCamera | None = None, t_ns: int | None = None
    ) -> R:
        """Return the result with the map's identity, its geopose, the camera and the time
        (nanoseconds)."""
        if isinstance(camera, UncalibratedCamera):
            focal = result.focal_length_px if isinstance(result, Localization) else None
            camera = None if focal is None else camera.with_focal(focal)
        of_map = Provenance(self.map_id, self.topomap.version, t_ns=t_ns, camera=camera)
        provenance = replace(of_map, features=result.provenance.features)
        georeference = self.topomap.georeference
        if isinstance(result, NotLocalized):
            alternatives = result.alternatives
            if georeference:
                alternatives = tuple(
                    replace(one, geopose=georeference.geopose(one.world_from_cam))
                    for one in alternatives
                )
            return replace(result, provenance=provenance, alternatives=alternatives)
        return replace(
            result,
            provenance=provenance,
            geopose=georeference.geopose(result.world_from_cam) if georeference else None,
        )

    def _searches(self, query: Query, trace: Trace | None) -> list[Search]:
        """Return one search for each feature type. Each search links to the previous one."""
        searches = list[Search]()
        for kind in self._kinds:
            of_kind = replace(query, feature_config=kind.map.feature_config)
            search = Search(
                of_kind, kind.map, kind.config, kind.weights, kind.correlated_errors, trace
            )
            if searches:
                search.previous, searches[-1].is_last = searches[-1], False
            searches.append(search)
        return searches

    @property
    def correlated_errors(self) -> float:
        """Return the correlated error share (rho) of the map for its first feature type.

        It is the share of a match's variance that the map's points have in common.
        """
        return self._kinds[0].correlated_errors

    def _query(self, query_image: QueryImage, max_ms: float | None) -> Query:
        image, camera = query_image.image, query_image.camera
        start, limit = time.perf_counter(), max_ms if max_ms is not None else self.config.max_ms
        reduced, reduced_camera = reduce_image(
            image, camera, self.map.focal, self.config.max_finer, self.config.max_side_px
        )
        deadline = float("inf") if limit is None else start + limit / 1e3
        return Query(
            reduced,
            reduced_camera,
            image.shape[1] / reduced_camera.width,
            self.map.feature_config,
            deadline=deadline,
            shared=query_image.features,
        )
