"""Localize a single image in an atlas: select tiles, order them, and decide when to stop.

The image's features are extracted once for all tiles. The index ranks the tiles (`index.py`) with
the cheapest feature type. A tile with a large margin is searched exhaustively at once
(`localization/localizer.py`). Otherwise the likeliest tiles are searched coarse only, by retrieval,
until a pose is clear. If none is, the next feature type ranks the tiles and more are searched
coarse only. The most promising ones are then searched exhaustively until one localizes the image.

Last, similar tiles are checked for a rival pose (`tile_results.py`), because perceptual aliasing
grows with the number of places. They are searched like similar places within a map. A tile is
skipped if far fewer of the image's strongest features agree with it.
"""

from __future__ import annotations

import copy
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from typing import Literal

from topoloc.atlas.atlas import Atlas
from topoloc.atlas.atlas_query_session import AtlasQuerySession, TileRanking
from topoloc.atlas.config import AtlasConfig
from topoloc.atlas.location_prior import LocationPrior, tiles_in_reach
from topoloc.atlas.map_cache import CachedMap, MapCache
from topoloc.atlas.tile_results import TileResult, merge_tile_results, with_tile
from topoloc.bounds import check_bounds
from topoloc.errors import AtlasError, MapError, MissingExtraError, ObjectStoreError, WeightsError
from topoloc.features.feature_types import FEATURE_TYPES, FeatureConfig, check_available
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.geometry.uncalibrated_camera import UncalibratedCamera
from topoloc.localization.localizer import LocalizerConfig
from topoloc.localization.query import Query, QueryImage, StageClock, reduce_image, unknown_camera
from topoloc.localization.result import Alternative, Localization, NotLocalized, with_time
from topoloc.retrieval.coarse import Image
from topoloc.retrieval.shared_vocabulary import shared_vocabulary

QueryMode = Literal["by all means", "at a glance", "as a rival"]
"""How a tile is searched: exhaustive, coarse only, or coarse only if it may rival a found pose."""


class AtlasLocalizer:
    """Localize images in a snapshot of an atlas.

    `problems` maps the ids of unreadable tiles to the reasons. The other tiles are still searched.

    Args:
        maps: opens the tiles and caches the most recently used ones.
        warn: called once for each tile that cannot be searched.

    Raises:
        ConfigError: a setting is out of bounds.
        AtlasError: the atlas has no tile.
    """

    def __init__(
        self,
        atlas: Atlas,
        maps: MapCache,
        config: AtlasConfig | None = None,
        warn: Callable[[str], None] = warnings.warn,
    ) -> None:
        self.atlas, self.config, self._maps, self._warn = atlas, config or AtlasConfig(), maps, warn
        check_bounds(self.config)
        if not atlas.manifest.tiles:
            raise AtlasError(
                f"the atlas {atlas.store.where} has no tiles; `topoloc atlas add` adds them"
            )
        self.problems: dict[str, str] = {}
        for note in atlas.notes:
            self._warn(note)
        for tile_id, problem in atlas.problems.items():
            self._warn(f"tile {tile_id} is asked after all others: {problem}")
        self._tiles_in_reach: Mapping[str, Rigid3 | None] | None = None
        self._out_of_reach_detail = ""
        self._focal = max(tile.focal_px for tile in atlas.manifest.tiles)

    def near(self, near: LocationPrior | None, georeferenced_only: bool = False) -> AtlasLocalizer:
        """Return a localizer that searches only tiles within a location prior
        (`location_prior.py`).

        If the prior holds a pose, it is used as the prior pose in these tiles.

        Args:
            georeferenced_only: use only tiles with a known position on earth.

        Raises:
            AtlasError: no tile belongs to the prior's world.
        """
        other = copy.copy(self)
        other._tiles_in_reach = tiles_in_reach(self.atlas.manifest, near, georeferenced_only)
        other._out_of_reach_detail = (
            f"no tile lies {near}" if near is not None else "no tile knows where on earth it lies"
        )
        return other

    def localize(
        self,
        image: Image,
        camera: Camera | UncalibratedCamera | None,
        prior: Rigid3 | None = None,
        max_ms: float | None = None,
        t_ns: int | None = None,
        tile_id: str | None = None,
    ) -> Localization | NotLocalized:
        """Estimate the pose and the tile of an image (grey or RGB, uint8).

        It works as `Localizer.localize`. The provenance of the result holds the tile. The pose is
        in the world of that tile.

        Args:
            prior: approximate pose in the world of the tile `tile_id`, which must be given.
            max_ms: time limit in milliseconds, instead of `config.max_ms`. No further tile or
                hypothesis is tested after it.
            tile_id: search only this tile.

        Raises:
            QueryError: the image is not an 8-bit image, or its size differs from the camera's.
            AtlasError: there is no such tile, a prior comes without one, or no tile can be read.
            ObjectStoreError: the object store of a required tile does not respond.
        """
        start, limit = time.perf_counter(), max_ms if max_ms is not None else self.config.max_ms
        deadline = float("inf") if limit is None else start + limit / 1e3
        query_image = QueryImage(image, camera or unknown_camera(image))
        if prior is not None and tile_id is None:
            raise AtlasError("a prior is a pose in one tile's world: name the tile")
        if tile_id is None and self._tiles_in_reach is not None and not self._tiles_in_reach:
            return self.with_provenance(
                NotLocalized("not_in_map", detail=self._out_of_reach_detail), t_ns
            )
        session, clock = AtlasQuerySession(query_image, deadline), StageClock()
        if tile_id is None:
            self._query_tiles(session, clock)
        else:
            self._query_tile(session, self.atlas.tile(tile_id).tile_id, 1.0, prior=prior)
        if not session.tile_results:
            raise AtlasError(
                f"no tile of the atlas {self.atlas.store.where} can be asked:"
                f" {next(iter(self.problems.values()), 'no time')}"
            )
        result = self._with_geopose(merge_tile_results(list(session.tile_results.values())))
        result = replace(
            result,
            times_ms=_merge_times(session, clock) | {"total": 1e3 * (time.perf_counter() - start)},
        )
        return result if t_ns is None else with_time(result, t_ns)

    def acquire_map(self, tile_id: str) -> CachedMap:
        """Return the map of a tile. It stays open until `release_map`.

        Raises:
            AtlasError, MapError: the tile is unknown, or its map cannot be read.
        """
        return self._maps.acquire_map(
            tile_id, self._maps.tile_path(self.atlas, self.atlas.tile(tile_id))
        )

    def release_map(self, opened: CachedMap) -> None:
        """Release a map from `acquire_map`, so that it may be closed."""
        self._maps.release_map(opened)

    def named(
        self, result: Localization | NotLocalized, tile_id: str
    ) -> Localization | NotLocalized:
        """Return the result of a tile's own map with the tile's id and its pose in the atlas."""
        return self._with_geopose(with_tile(result, self.atlas.tile(tile_id)))

    def _with_geopose(self, result: Localization | NotLocalized) -> Localization | NotLocalized:
        """Add the geopose for tiles that are georeferenced only through other tiles."""
        manifest, tile_id = self.atlas.manifest, result.provenance.tile
        if isinstance(result, NotLocalized):
            alternatives = [self._georeference_alternative(one) for one in result.alternatives]
            return replace(result, alternatives=tuple(alternatives)) if alternatives else result
        place = (
            manifest.georeference_of(manifest.by_id[tile_id])
            if tile_id is not None and result.geopose is None
            else None
        )
        return (
            result
            if place is None
            else replace(result, geopose=place.geopose(result.world_from_cam))
        )

    def _georeference_alternative(self, one: Alternative) -> Alternative:
        manifest = self.atlas.manifest
        place = (
            manifest.georeference_of(manifest.by_id[one.tile])
            if one.tile is not None and one.geopose is None
            else None
        )
        return one if place is None else replace(one, geopose=place.geopose(one.world_from_cam))

    def with_provenance(self, result: NotLocalized, t_ns: int | None = None) -> NotLocalized:
        """Return the result of an image that was not searched, with its capture time
        (nanoseconds)."""
        return result if t_ns is None else with_time(result, t_ns)

    def rank(self, query_image: QueryImage) -> TileRanking:
        """Return the tiles by similarity to the image, followed by those that cannot be ranked."""
        *_, ranking = self._rankings(query_image, StageClock())
        return ranking

    def _rankings(self, query_image: QueryImage, clock: StageClock) -> Iterator[TileRanking]:
        """Generate rankings with one feature type after another, until one tile has a clear
        margin."""
        sizes = LocalizerConfig()  # the same reduction as in tiles, so they reuse the features
        image, reduced_camera = reduce_image(
            query_image.image, query_image.camera, self._focal, sizes.max_finer, sizes.max_side_px
        )
        unranked = [
            (tile_id, 0.0)
            for tile_id in self.atlas.problems
            if self._tiles_in_reach is None or tile_id in self._tiles_in_reach
        ]
        vectors, ranking = {}, TileRanking()
        for kind in self._ranking_feature_types:
            vocabulary = shared_vocabulary(kind)
            assert vocabulary is not None
            features = Query(
                image,
                reduced_camera,
                1.0,
                FeatureConfig(kind=kind),
                clock,
                shared=query_image.features,
            ).features
            with clock.stage("tiles"):
                vectors[kind] = vocabulary.global_descriptor(
                    features, reduced_camera.width, reduced_camera.height
                )
                ranking = self.atlas.index.rank(
                    vectors, self.config.num_ranked, self._tiles_in_reach
                )
            yield ranking + unranked
            if _ranking_margin(ranking) >= self.config.settled_gap:
                return
        if not vectors:
            yield unranked

    @cached_property
    def _ranking_feature_types(self) -> list[str]:
        """Return the available feature types that can rank tiles, cheapest first."""
        return [
            kind for kind in FEATURE_TYPES if kind in self.atlas.index.kinds and _is_available(kind)
        ]

    def _query_tiles(self, session: AtlasQuerySession, clock: StageClock) -> None:
        """Search tiles until one localizes the image, then the similar tiles."""
        for number, ranking in enumerate(self._rankings(session.query_image, clock), start=1):
            session.ranking = ranking
            if _ranking_margin(self._readable_tiles(ranking)) < self.config.settled_gap:
                self._query_coarse_only(
                    session,
                    (
                        self.config.num_glanced
                        if number >= len(self._ranking_feature_types)
                        else self.config.num_glanced_first
                    ),
                )
            if session.is_settled or session.is_past_deadline:
                break
        hopeful = self._candidate_tiles(session)
        for number in range(self.config.num_asked):
            left = [
                one for one in self._readable_tiles(hopeful) if not session.is_fully_queried(one[0])
            ]
            if number:
                left = [one for one in left if self._is_promising(session, one)]
            if (
                not left
                or session.localized_tiles
                or (session.tile_results and session.is_past_deadline)
            ):
                break
            self._query_tile(session, *max(left, key=session.query_priority))
        while not session.tile_results and (
            left := self._readable_tiles(session.ranking)
        ):  # the likely tiles cannot be read
            self._query_tile(session, *left[0])
        self._query_similar_tiles(session)

    def _candidate_tiles(self, session: AtlasQuerySession) -> TileRanking:
        """Return the tiles that are nearly as similar to the image as the best one."""
        ranking = self._readable_tiles(session.ranking)
        return [
            one
            for one in ranking
            if one[1] >= ranking[0][1] - self.config.hopeless_gap or one[0] in self.atlas.problems
        ]

    def _is_promising(self, session: AtlasQuerySession, ranked: tuple[str, float]) -> bool:
        """Return whether the coarse search found a pose or the tile is similar enough to the image.

        Tiles that cannot be ranked are always promising.
        """
        return (
            session.query_priority(ranked) >= (0.0, self.config.least_likeness)
            or ranked[0] in self.atlas.problems
        )

    def _query_coarse_only(self, session: AtlasQuerySession, num_tiles: int) -> None:
        """Search the likeliest tiles coarse only, until a pose is clear."""
        for tile_id, similarity in self._candidate_tiles(session)[:num_tiles]:
            if session.is_settled or session.is_past_deadline:
                return
            if tile_id not in session.tile_results:
                self._query_tile(session, tile_id, similarity, "at a glance")

    def _readable_tiles(self, ranking: TileRanking) -> TileRanking:
        """Return the ranking without unreadable tiles."""
        return [one for one in ranking if one[0] not in self.problems]

    def _query_similar_tiles(self, session: AtlasQuerySession) -> None:
        """Search tiles that are about as similar to the image as the one that localized it.

        A tile is searched coarse only, if a quick test does not exclude it as a rival.
        """
        if not session.localized_tiles:
            return
        least = min(answer.similarity for answer in session.localized_tiles) - self.config.alike_gap
        alike = [
            (tile_id, similarity)
            for tile_id, similarity in session.ranking
            if similarity >= least and tile_id not in session.tile_results
        ]
        for tile_id, similarity in alike[: self.config.num_alike]:
            if not session.is_past_deadline:
                self._query_tile(session, tile_id, similarity, "as a rival")
        for one in [
            one for one in session.tile_results.values() if one.is_clear and not one.is_exhaustive
        ]:  # one of them may hold the true pose
            self._query_tile(session, one.tile.tile_id, one.similarity)

    def _query_tile(
        self,
        session: AtlasQuerySession,
        tile_id: str,
        similarity: float,
        mode: QueryMode = "by all means",
        prior: Rigid3 | None = None,
    ) -> None:
        """Search the image in a tile. If the tile cannot be read, it is recorded in `problems`."""
        if tile_id in self.problems:
            session.tile_results.pop(tile_id, None)
            return
        tile = self.atlas.tile(tile_id)
        try:
            with self._maps.use_map(tile_id, self._maps.tile_path(self.atlas, tile)) as opened:
                known = (
                    prior
                    if prior is not None or self._tiles_in_reach is None
                    else self._tiles_in_reach.get(tile_id)
                )
                before, query_session = session.map_sessions.get(tile_id, (None, None))
                if query_session is None or before is not opened:
                    query_session = opened.localizer.query_session(
                        session.query_image, known, session.remaining_ms
                    )
                session.map_sessions[tile_id] = opened, query_session
                if mode == "as a rival" and not session.can_be_rival(query_session):
                    return
                result, named = (
                    query_session.localize_exhaustive()
                    if mode == "by all means"
                    else query_session.localize_coarse_only()
                )
        except ObjectStoreError:  # the tile is fine, but its result is unknown
            raise
        except MapError as error:
            self.problems[tile_id] = str(error)
            session.tile_results.pop(tile_id, None)
            self._warn(f"tile {tile_id} is not asked: {error}")
            return
        session.tile_results[tile_id] = TileResult(
            tile, result, tuple(one for one, _ in named), mode == "by all means", similarity
        )


def _ranking_margin(ranking: TileRanking) -> float:
    """Return the similarity margin of the best tile over the second, infinite for a single tile."""
    return ranking[0][1] - ranking[1][1] if len(ranking) > 1 else float("inf")


def _is_available(kind: str) -> bool:
    try:
        check_available(kind)
    except (MissingExtraError, WeightsError):
        return False
    return True


def _merge_times(session: AtlasQuerySession, clock: StageClock) -> dict[str, float]:
    """Return the milliseconds of each stage, summed over all tiles.

    `tiles` is the ranking of tiles, without feature extraction.
    """
    total = clock.times_ms()
    for _, query_session in session.map_sessions.values():
        for stage, ms in query_session.times_ms.items():
            total[stage] = total.get(stage, 0.0) + ms
    return total
