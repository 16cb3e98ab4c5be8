"""Localizing a single image in the topo-metric map: section III-B of the paper, read from the top.

The coarse localizer names the nodes that the image may belong to; the image is patch-normalised and
its features are matched with those of the nodes; PnP on the matches gives the camera's global pose.
Unlike the paper's blind first choice, this is one loop of hypotheses (`query_session.py`): first
poses are proposed (`propose.py`), the cheapest and likeliest first; each is refined in the same
way, its evidence counted (`refine.py`), and it joins what is believed (`belief.py`), until that is
settled. A pose is reported only where the evidence for it is strong and nothing else in the map
explains the image as well. One candidate, no guided step, no look-alikes, viewpoints and walls
(`num_candidates=1`, `guided.num_nodes=0`, `look_alikes.max_groups=0`, `viewpoints.num_nodes=0`,
`walls.num_places=0`) give the paper's own behaviour.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from topoloc.bounds import check_bounds
from topoloc.features.feature_types import select_stored_types
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
    """Holds an open map, its coarse localizer and the nodes used lately.

    `unavailable_types` names the map's kinds of features that are not asked because their network,
    or ONNX Runtime, is not here, each with what it lacks.

    Args:
        topomap: the map, or the path of its file, which is opened.
        features: the map's feature types that are used: `learned`, `both`, or names such as
            `surf,topoloc-net`; by default those of `config.kinds`.
        coarse: names the candidate nodes instead of one of the map's own coarse localizers: any
            object with `CoarseLocalizer.rank` (`topoloc/retrieval/coarse.py`), such as retrieval of
            another kind or a prior from elsewhere. `config.coarse` is then left aside.
        weights: what the evidence counts, instead of what ships for the map's kind of features.

    Raises:
        ConfigError: a setting is out of bounds.
        FeatureKindError: the map's features are of a kind that there is not.
        EmptyMapError: the map has no node.
        MapError: the map file cannot be read, or the map has no such coarse localizer.
        MissingExtraError, WeightsError: a network of features is not here, and the map has no
            others, or `config.kinds` names them.
    """

    def __init__(
        self,
        topomap: TopoMetricMap | str | Path,
        config: LocalizerConfig | None = None,
        coarse: CoarseLocalizer | None = None,
        weights: FittedWeights | None = None,
        features: str | None = None,
    ) -> None:
        if isinstance(topomap, str | Path):
            topomap = TopoMetricMap.load(topomap)
        config = config or LocalizerConfig()
        if features is not None:
            config = replace(config, kinds=select_stored_types(topomap.kinds, features))
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
        """Where was this image (grey or RGB, uint8) taken, by a camera of this calibration?

        Of a camera that is only roughly known, or not at all (None), the focal length is found with
        the pose; that takes a few times as long, and it is taken for a pinhole.

        Args:
            prior: about where the camera is (world_from_cam): the nodes nearest to it replace the
                coarse search. The pose needs the same evidence as any other, of matches that the
                prior did not guide.
            max_ms: after so many milliseconds no further hypothesis is sought, instead of
                `config.max_ms`.
            trace: collects all that is tried.
            t_ns: when it was taken, nanoseconds, for the result to say.

        Raises:
            QueryError: the image is no picture of 8 bits, or the camera is of another image size.
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
        """As `localize`; also each pose that the result names (its own, or its alternatives) with
        the points that it stands on."""
        return self.localize_query(QueryImage(image, camera), prior, max_ms, trace)

    def localize_query(
        self,
        query_image: QueryImage,
        prior: Rigid3 | None = None,
        max_ms: float | None = None,
        trace: Trace | None = None,
    ) -> ResultWithInliers:
        """As `localize_with_inliers`, of a picture whose features other maps may have asked for
        before."""
        return self.query_session(query_image, prior, max_ms, trace).localize_exhaustive()

    def query_session(
        self,
        query_image: QueryImage,
        prior: Rigid3 | None = None,
        max_ms: float | None = None,
        trace: Trace | None = None,
    ) -> QuerySession:
        """The same question, to be put at a glance first."""
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
        """The same map as if nobody had stood at these nodes: a picture that was taken there is
        then asked of the rest of the map.

        At least one node is left; the walls along the way are not asked. Raises KeyError where the
        map has no node of such an id.
        """
        rows, other = [self.topomap.row_of(node_id) for node_id in node_ids], copy.copy(self)
        other._kinds = [replace(kind, map=kind.map.without(rows)) for kind in self._kinds]
        other.map = other._kinds[0].map
        return other

    def with_provenance(
        self, result: R, camera: Camera | UncalibratedCamera | None = None, t_ns: int | None = None
    ) -> R:
        """The result with the map that it is of, where on earth that is, the picture's camera, and
        its time (nanoseconds)."""
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
        """One by each kind of features, which know those before them."""
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
        """rho of the map by its first kind of features: the share of a match's variance that its
        points have in common."""
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
