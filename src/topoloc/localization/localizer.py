"""Localize images in a map, or in an atlas of many maps (section III-B of the paper).

The coarse localizer ranks candidate nodes. The image is patch-normalised and its features are
matched with those of the nodes. PnP on the matches gives the camera's global pose.

The paper keeps the first pose without a check. This localizer runs one loop over pose proposals
instead (`map_query.py`), cheapest and likeliest first. Each one is verified in the same way
(`search.py`): it is refined and its evidence counted. It then enters the belief over hypotheses
(`belief.py`), until the result is settled. A pose is reported only if its evidence is strong and no
other place explains the image as well. The checks of `decision.py` then change or refuse it. A map
is an atlas of one tile. `decision.py` chooses tiles, and `tiles/tiles.py` compares their poses.

These settings give the paper's own behaviour: `num_candidates=1`, `guided.num_nodes=0`,
`look_alikes.max_groups=0`, `viewpoints.num_nodes=0`, `walls.num_places=0`.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from topoloc.atlas.config import AtlasConfig
from topoloc.bounds import check_bounds
from topoloc.errors import AtlasError
from topoloc.geometry.camera import Camera, UncalibratedCamera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.answer import ResultWithInliers
from topoloc.localization.config import LocalizerConfig
from topoloc.localization.decision import Schedule
from topoloc.localization.fitted_weights import FittedWeights
from topoloc.localization.map_context import MapContext
from topoloc.localization.query import CameraLike, Deadline, QueryImage, StageClock, camera_of
from topoloc.localization.result import Localization, NotLocalized, R, with_time
from topoloc.localization.search import Trace
from topoloc.localization.tiles.tiles import Reach, TileRanking, Tiles
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.node_ids import NodeId
from topoloc.recordings.image_mask import read_mask, with_mask
from topoloc.retrieval.coarse import CoarseLocalizer, Image

if TYPE_CHECKING:
    from topoloc.atlas.atlas import Atlas
    from topoloc.atlas.location_prior import LocationPrior
    from topoloc.atlas.map_cache import MapCache

__all__ = ["Localizer", "LocalizerConfig"]


class Localizer:
    """Localize images in a map, or in a snapshot of an atlas.

    `source` is the map or the atlas. If tiles cannot be read, the other ones are still searched.

    Args:
        source: the map or the atlas; or the path of a map file or the address of an atlas, which
            is opened; or a map that is open for queries already, with its settings.
        features: the map's feature types that are used: `learned`, `both`, or names such as
            `surf,topoloc-net`. By default those of `config.kinds`.
        coarse: ranks the candidate nodes instead of one of the map's own coarse localizers. Any
            object with `CoarseLocalizer.rank` (`topoloc/retrieval/coarse.py`) works, such as
            another retrieval method or an external prior. `config.coarse` is then ignored.
        weights: fitted weights to use instead of those shipped for the map's first feature type.
        tiles: how the tiles of an atlas are selected.
        maps: opens the tiles of an atlas and keeps the last ones open, for several localizers. By
            default each localizer keeps up to 512 MB open.
        warn: called once for each tile that cannot be searched, and once for each feature type of
            the map that cannot be used.

    Raises:
        ConfigError: a setting is out of bounds.
        UnreadableImageError: the mask of `config` is no image; CalibrationError: it is all black.
        FeatureTypeError: the map's feature type is unknown.
        EmptyMapError: the map has no node.
        MapError: the map file cannot be read, or the map has no such coarse localizer.
        AtlasError: the atlas is damaged, or has no tile.
        WeightsError: a feature network is not installed, and the map has no other feature type or
            `config.kinds` names this one.
    """

    def __init__(
        self,
        source: TopoMetricMap | Atlas | MapContext | str | Path,
        config: LocalizerConfig | None = None,
        coarse: CoarseLocalizer | None = None,
        weights: FittedWeights | None = None,
        features: str | None = None,
        tiles: AtlasConfig | None = None,
        maps: MapCache[Localizer] | None = None,
        warn: Callable[[str], None] = warnings.warn,
    ) -> None:
        self.tile_config = tiles or AtlasConfig()
        check_bounds(self.tile_config)
        self._reach: Reach | None = None
        self._nothing_in_reach = ""
        self._options = coarse, weights, features, tiles
        is_open = isinstance(source, MapContext)
        self.config = source.config if is_open else config or LocalizerConfig()
        self._mask = None if self.config.mask is None else read_mask(self.config.mask)
        if is_open:
            self.source, self._options, self._tiles = source.topomap, None, Tiles(source)
            return
        check_bounds(self.config)

        def open_context(topomap: TopoMetricMap) -> MapContext:
            opened = MapContext.from_map(topomap, self.config, coarse, weights, features)
            for kind, lacking in opened.unavailable_types.items():
                warn(f"features {kind} of the map are not used: {lacking}")
            return opened

        if isinstance(source, str | Path):
            from topoloc.atlas.place import open_place  # an open map does not need this module

            source = open_place(str(source)).visit(TopoMetricMap.load, lambda atlas: atlas)
        self.source = source
        if isinstance(source, TopoMetricMap):
            self._tiles = Tiles(open_context(source))
        else:
            # a single map does not need these modules
            from topoloc.atlas.map_cache import MapCache
            from topoloc.localization.tiles.atlas_tiles import AtlasTiles

            maps = maps or MapCache.with_memory([], lambda one: Localizer(open_context(one)), 512)
            self._tiles = AtlasTiles(source, maps, self.tile_config, warn)

    def __reduce__(self) -> tuple[type[Localizer], tuple[Any, ...], dict[str, Any]]:
        """Return what opens the same map in another process. Raises TypeError: it may be a part."""
        if self._options is None:
            raise TypeError("a localizer of an open map cannot be pickled: use one of its file")
        state = {"_reach": self._reach, "_nothing_in_reach": self._nothing_in_reach}
        return Localizer, (self.source, self.config, *self._options), state

    @property
    def context(self) -> MapContext:
        """Return the open map. Raises AtlasError: this is an atlas."""
        return self._tiles.opened

    @property
    def topomap(self) -> TopoMetricMap:
        """Return the map. Raises AtlasError: this is an atlas."""
        return self.context.topomap

    @property
    def unavailable_types(self) -> dict[str, str]:
        """Return why feature types of the map are not used. Raises AtlasError: this is an atlas."""
        return self.context.unavailable_types

    @property
    def tile_ids(self) -> list[str]:
        """Return the ids of the tiles. A map is one tile with the id ""."""
        return self._tiles.ids

    @property
    def problems(self) -> dict[str, str]:
        """Return the reason for each tile, by id, that cannot be searched."""
        return self._tiles.problems

    @contextmanager
    def in_tile(self, tile_id: str | None = None) -> Iterator[Localizer]:
        """Yield a localizer for one tile alone, None: the only one. Its map stays open meanwhile.

        Raises:
            AtlasError: there is no such tile, or several and none is named.
            MapError: its map cannot be read.
        """
        tile_id = self._tile_id(tile_id)
        with self._tiles.use(tile_id) as opened:
            tiles = self._tiles.alone(tile_id, opened)
            other = self if tiles is self._tiles else copy.copy(self)
            other._tiles, other._reach, other.source = tiles, None, opened.topomap
            yield other

    def near(self, near: LocationPrior | None, georeferenced_only: bool = False) -> Localizer:
        """Return a localizer that searches only tiles within a location prior
        (`atlas/location_prior.py`).

        If the prior holds a pose, it is used as the prior pose in these tiles.

        Args:
            georeferenced_only: use only tiles with a known position on earth.

        Raises AtlasError: no tile belongs to the prior's world, or this is one map.
        """
        other = copy.copy(self)
        other._reach = self._tiles.in_reach(near, georeferenced_only)
        other._nothing_in_reach = (
            f"no tile lies {near}" if near is not None else "no tile knows where on earth it lies"
        )
        return other

    def without(self, node_ids: Iterable[NodeId]) -> Localizer:
        """Return a localizer for the same map without these nodes.

        An image recorded at one of them is then localized in the rest of the map. At least one node
        must remain. Virtual views are not used.

        Raises:
            AtlasError: this is an atlas.
            KeyError: the map has no node with such an id.
            EmptyMapError: no node remains.
        """
        return Localizer(self.context.without(node_ids))

    def localize(
        self,
        image: Image,
        camera: CameraLike | None,
        prior: Rigid3 | None = None,
        max_ms: float | Deadline | None = None,
        trace: Trace | None = None,
        t_ns: int | None = None,
        tile_id: str | None = None,
    ) -> Localization | NotLocalized:
        """Estimate the pose of an image (grey or RGB, uint8). In an atlas it is in the world of the
        tile that the provenance names. Of a camera that is not exactly known the focal length is
        estimated, too, and principal point and distortion if the residuals ask for it. This takes a
        few times as long.

        Args:
            camera: camera model of the image, exact or approximate; K, (fx, fy, cx, cy) in pixels,
                or the path of a calibration. None: unknown.
            prior: approximate pose (world_from_cam). The nodes nearest to it replace coarse
                retrieval. The pose needs the same evidence as any other, from matches that the
                prior did not guide. In an atlas it is in the world of the tile `tile_id`.
            max_ms: time limit in milliseconds, or a `Deadline`, instead of `config.max_ms`. No
                further tile or hypothesis is tested after it.
            trace: collects all tried proposals.
            t_ns: capture time in nanoseconds, stored in the result.
            tile_id: search only this tile.

        Raises:
            QueryError: the image is not an 8-bit image, or its size differs from the camera's.
            CalibrationError: the image has another shape than the mask of `config`.
            AtlasError: there is no such tile, a prior comes without one, or no tile can be read.
            ObjectStoreError: the object store of a required tile does not respond.
        """
        query_image = QueryImage(image, camera_of(image, camera))
        result = self.localize_query(query_image, prior, max_ms, trace, tile_id)[0]
        return result if t_ns is None else with_time(result, t_ns)

    def localize_query(
        self,
        query_image: QueryImage,
        prior: Rigid3 | None = None,
        max_ms: float | Deadline | None = None,
        trace: Trace | None = None,
        tile_id: str | None = None,
    ) -> ResultWithInliers:
        """Localize as `localize` does, and also return the inliers of each reported pose.

        The reported poses are the result's own pose, or its alternatives. The query image caches
        its features, which several maps can share.
        """
        deadline = Deadline.from_limit(self.config.max_ms if max_ms is None else max_ms)
        if self._mask is not None:
            masked = with_mask(query_image.camera, self._mask)
            query_image = replace(query_image, camera=masked)
        schedule = Schedule(
            self._tiles, self.tile_config, query_image, deadline, self._reach, trace
        )
        if prior is not None or tile_id is not None or len(self.tile_ids) == 1:
            schedule.search_tile(self._tile_id(tile_id), prior=prior)
        elif self._reach is not None and not self._reach:
            return NotLocalized("not_in_map", detail=self._nothing_in_reach), []
        else:
            schedule.search_all()
        return schedule.outcome()

    def rank_tiles(self, image: Image, camera: Camera | UncalibratedCamera) -> TileRanking:
        """Return the tiles by their similarity to an image, followed by those that cannot be
        ranked."""
        *_, ranking = self._tiles.rankings(QueryImage(image, camera), StageClock(), self._reach)
        return ranking

    def to_world_of(
        self, tile_id: str | None, other_id: str | None, world_from_cam: Rigid3
    ) -> Rigid3 | None:
        """Return a pose in the world of one tile as a pose in the world of another one.

        None if the transform between them is unknown. Raises AtlasError: there is no such tile.
        """
        known = self._tiles.other_from_world(self._tile_id(tile_id), self._tile_id(other_id))
        return None if known is None else known @ world_from_cam

    def with_provenance(
        self, result: R, camera: Camera | UncalibratedCamera | None = None, t_ns: int | None = None
    ) -> R:
        """Return the result with the map's identity, its geopose, the camera and the time
        (nanoseconds). In an atlas only the time is known."""
        return self._tiles.with_provenance(result, camera, t_ns)

    def _tile_id(self, tile_id: str | None) -> str:
        if tile_id is not None:
            return tile_id
        if len(self.tile_ids) > 1:
            raise AtlasError("the atlas has several tiles: name the one that is meant")
        return self.tile_ids[0]
