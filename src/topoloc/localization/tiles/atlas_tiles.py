"""Search the tiles of an atlas. The index ranks them, and a cache keeps the last ones open."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

from msgspec import structs

from topoloc.atlas.atlas import Atlas
from topoloc.atlas.config import AtlasConfig
from topoloc.atlas.joint_worlds import sigmas_at
from topoloc.atlas.location_prior import LocationPrior, tiles_in_reach
from topoloc.atlas.manifest import Tile
from topoloc.atlas.map_cache import RETRY_AFTER_S, MapCache
from topoloc.errors import AtlasError, MapError
from topoloc.features.feature_types import FEATURE_TYPES, FeatureConfig, find_available_types
from topoloc.geometry.camera import Camera, UncalibratedCamera
from topoloc.geometry.geodesy import Georeference
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.config import LocalizerConfig
from topoloc.localization.map_context import MapContext
from topoloc.localization.query import Query, QueryImage, StageClock, reduce_image
from topoloc.localization.result import Localization, NotLocalized, R, with_time
from topoloc.localization.tiles.tiles import Reach, TileRanking, Tiles, ranking_margin
from topoloc.retrieval.shared_vocabulary import shared_vocabulary

if TYPE_CHECKING:
    from topoloc.localization.localizer import Localizer

_SAME_METRES, _SAME_DEG = 1.0, 5.0
_SIGMAS = 3.0  # sigmas of a join, added to these limits, at most doubling them


class AtlasTiles(Tiles):
    """Search the tiles of a snapshot of an atlas.

    Args:
        maps: opens the tiles and caches the most recently used ones.
        warn: called once for each problem of a tile. The tile is tried again after a while.

    Raises:
        AtlasError: the atlas has no tile.
    """

    def __init__(
        self,
        atlas: Atlas,
        maps: MapCache[Localizer],
        config: AtlasConfig,
        warn: Callable[[str], None],
    ) -> None:
        if not atlas.manifest.tiles:
            raise AtlasError(
                f"the atlas {atlas.store.where} has no tiles; `topoloc atlas add` adds them"
            )
        self.atlas, self.config, self._maps, self._warn = atlas, config, maps, warn
        self.ids, self.problems = list(atlas.manifest.by_id), dict[str, str]()
        self._retry_times = dict[str, float]()
        self.unranked = frozenset(atlas.index.problems)
        for note in atlas.index.notes:
            warn(note)
        for tile_id, problem in atlas.index.problems.items():
            warn(f"tile {tile_id} is searched after all others: {problem}")
        self._focal = max(tile.focal_px for tile in atlas.manifest.tiles)

    @property
    def opened(self) -> MapContext:
        """Raise AtlasError, because there is no single map."""
        raise AtlasError("an atlas has many maps: in_tile opens one of them")

    def alone(self, tile_id: str, opened: MapContext) -> Tiles:
        """Return a tile, whose map is open, as the only one."""
        return Tiles(opened, self, tile_id)

    @contextmanager
    def use(self, tile_id: str) -> Iterator[MapContext]:
        """Keep the map of a tile open for the context. Raises AtlasError, MapError."""
        path = self._maps.tile_path(self.atlas, self.atlas.tile(tile_id))
        with self._maps.use_map(tile_id, path) as cached:
            self.problems.pop(tile_id, None)
            yield cached.content.context

    def can_search(self, tile_id: str) -> bool:
        """See `Tiles.can_search`."""
        return time.monotonic() >= self._retry_times.get(tile_id, 0.0)

    def report(self, tile_id: str, error: MapError) -> None:
        """Record that a tile cannot be searched for a while."""
        self._retry_times[tile_id] = time.monotonic() + RETRY_AFTER_S
        if self.problems.get(tile_id) != str(error):
            self._warn(f"tile {tile_id} is not searched: {error}")
        self.problems[tile_id] = str(error)

    def in_reach(self, near: LocationPrior | None, georeferenced_only: bool) -> Reach:
        """Return the tiles in reach of a position. Raises AtlasError: it is in no world here."""
        return tiles_in_reach(self.atlas.manifest, near, georeferenced_only)

    def rankings(
        self, query_image: QueryImage, clock: StageClock, reach: Reach | None
    ) -> Iterator[TileRanking]:
        """Generate rankings with one feature type after another, until one tile has a clear
        margin. Tiles that cannot be ranked come last."""
        sizes = LocalizerConfig()  # the same reduction as in tiles, so they reuse the features
        image, camera = reduce_image(
            query_image.image, query_image.camera, self._focal, sizes.max_finer, sizes.max_side_px
        )
        unranked = [
            (tile_id, 0.0)
            for tile_id in self.atlas.index.problems
            if reach is None or tile_id in reach
        ]
        vectors, ranking = {}, TileRanking()
        for kind in self._ranking_feature_types:
            vocabulary = shared_vocabulary(kind)
            assert vocabulary is not None
            features = Query(
                image, camera, 1.0, FeatureConfig(kind=kind), clock, shared=query_image.features
            ).features
            with clock.stage("tiles"):
                vectors[kind] = vocabulary.global_descriptor(features, camera.width, camera.height)
                ranking = self.atlas.index.rank(vectors, self.config.num_ranked, reach)
            yield ranking + unranked
            if ranking_margin(ranking) >= self.config.min_ranking_margin:
                return
        if not vectors:
            yield unranked

    @cached_property
    def _ranking_feature_types(self) -> list[str]:
        """Return the available feature types that can rank tiles, cheapest first."""
        return find_available_types(one for one in FEATURE_TYPES if one in self.atlas.index.kinds)

    def other_from_world(self, tile_id: str, other_id: str) -> Rigid3 | None:
        """Return the transform from the world of a tile to that of another, None if unknown."""
        return self.atlas.tile(other_id).from_world_of(self.atlas.tile(tile_id))

    def may_be_same_pose(
        self, tile_id: str, pose: Localization, other_id: str, other_pose: Localization
    ) -> bool:
        """Return whether poses of two tiles are the same, if the transform between the tiles is
        known. For joined tiles the tolerance includes the sigmas of the joins."""
        world_from_other = self.other_from_world(other_id, tile_id)
        if world_from_other is None:
            return False
        metres, radians = _join_sigmas(self.atlas.tile(tile_id), pose, self.atlas.tile(other_id))
        return pose.world_from_cam.is_same(
            world_from_other @ other_pose.world_from_cam,
            _SAME_METRES + min(_SIGMAS * metres, _SAME_METRES),
            math.radians(_SAME_DEG + min(_SIGMAS * math.degrees(radians), _SAME_DEG)),
        )

    def with_tile(self, result: R, tile_id: str) -> R:
        """Return the result with the tile's id, and the pose in the atlas, in the joint world and
        on earth if they are known."""
        tile = self.atlas.tile(tile_id)
        if isinstance(result, NotLocalized):
            alternatives = [
                structs.replace(
                    one,
                    tile=one.tile or tile_id,
                    geopose=one.geopose or self._geopose(one.tile or tile_id, one.world_from_cam),
                )
                for one in result.alternatives
            ]
            result = replace(result, alternatives=tuple(alternatives))
        pose, joint_pose = None, None
        if isinstance(result, Localization):
            geopose = result.geopose or self._geopose(tile_id, result.world_from_cam)
            result = replace(result, geopose=geopose)
            if tile.atlas_from_world is not None:
                pose = tile.atlas_from_world @ result.world_from_cam
            if tile.joint is not None:
                joint_pose = tile.joint.joint_from_world @ result.world_from_cam
        provenance = replace(
            result.provenance,
            tile=tile_id,
            atlas_from_cam=pose,
            joint_world=None if tile.joint is None else tile.joint.joint,
            joint_from_cam=joint_pose,
        )
        return replace(result, provenance=provenance)

    def with_provenance(
        self, result: R, camera: Camera | UncalibratedCamera | None, t_ns: int | None
    ) -> R:
        """Return the result with its time. No tile is known."""
        return result if t_ns is None else with_time(result, t_ns)

    def _geopose(self, tile_id: str, world_from_cam: Rigid3):
        """Return the pose on earth, None if the tile is not georeferenced, alone or by others."""
        known: Georeference | None = self.atlas.manifest.georeference_of(self.atlas.tile(tile_id))
        return None if known is None else known.geopose(world_from_cam)


def _join_sigmas(tile: Tile, pose: Localization, other: Tile) -> tuple[float, float]:
    """Return the sigmas of the transform between two tiles at a pose: metres and radians.

    They are 0 if no join is involved.
    """
    here, there = tile.joint, other.joint
    if tile.world == other.world or here is None or there is None or here.joint != there.joint:
        return 0.0, 0.0
    return sigmas_at(
        (here.joint_from_world @ pose.world_from_cam).translation,
        here.covariance + there.covariance,
    )
