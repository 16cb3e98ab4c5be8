"""Define the tiles that a localizer searches: one map, or the maps of an atlas.

A map file is searched as an atlas of one tile. `OneMap` is that atlas. `atlas_tiles.py` holds the
other one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from topoloc.errors import AtlasError, MapError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.geometry.uncalibrated_camera import UncalibratedCamera
from topoloc.localization.map_context import MapContext
from topoloc.localization.query import QueryImage, StageClock
from topoloc.localization.result import Localization, R

if TYPE_CHECKING:
    from topoloc.atlas.location_prior import LocationPrior

TileRanking = list[tuple[str, float]]
"""Tiles with the similarity of their best node, the most similar first."""
Reach = Mapping[str, Rigid3 | None]
"""Tiles that may be searched, each with the prior pose (world_from_cam) in its world or None."""


@runtime_checkable
class Tiles(Protocol):
    """Define the tiles that a localizer searches.

    `problems` maps the ids of tiles that cannot be searched to the reasons.
    """

    @property
    def ids(self) -> list[str]:
        """Return the ids of all tiles."""
        ...

    @property
    def problems(self) -> dict[str, str]:
        """Return the reason for each tile, by id, that cannot be searched."""
        ...

    @property
    def unranked(self) -> frozenset[str]:
        """Return the tiles that the index cannot rank."""
        ...

    def use(self, tile_id: str) -> AbstractContextManager[MapContext]:
        """Keep the map of a tile open for the context.

        Raises:
            AtlasError: there is no such tile.
            MapError: the map cannot be read.
        """
        ...

    def report(self, tile_id: str, error: MapError) -> None:
        """Record that a tile cannot be searched. Raises the error if no other tile is left."""
        ...

    def in_reach(self, near: LocationPrior | None, georeferenced_only: bool) -> Reach:
        """Return the tiles in reach of a position. Raises AtlasError: the prior does not fit."""
        ...

    def rankings(
        self, query_image: QueryImage, clock: StageClock, reach: Reach | None
    ) -> Iterator[TileRanking]:
        """Generate rankings of the tiles, each with one more feature type."""
        ...

    def other_from_world(self, tile_id: str, other_id: str) -> Rigid3 | None:
        """Return the transform from the world of a tile to that of another, None if unknown."""
        ...

    def may_be_same_pose(
        self, tile_id: str, pose: Localization, other_id: str, other_pose: Localization
    ) -> bool:
        """Return whether poses of two tiles may be the same."""
        ...

    def with_tile(self, result: R, tile_id: str) -> R:
        """Return the result of a tile's map with the tile's id and its pose in the atlas."""
        ...

    def with_provenance(
        self, result: R, camera: Camera | UncalibratedCamera | None, t_ns: int | None
    ) -> R:
        """Return a result that no map computed with all that is known of its source."""
        ...


class OneMap:
    """Search one map. If it is a tile of an atlas, `of` and `tile_id` name it in the results."""

    def __init__(self, opened: MapContext, of: Tiles | None = None, tile_id: str = "") -> None:
        self.opened, self._of, self._tile_id = opened, of, tile_id
        self.ids, self.problems, self.unranked = [tile_id], dict[str, str](), frozenset[str]()

    @contextmanager
    def use(self, tile_id: str) -> Iterator[MapContext]:
        """Return the map. Raises AtlasError: there is no such tile."""
        if tile_id != self._tile_id:
            raise AtlasError(f"a map has no tile {tile_id[:80]!r}: tiles are parts of an atlas")
        yield self.opened

    def report(self, tile_id: str, error: MapError) -> None:
        """Raise the error."""
        raise error

    def in_reach(self, near: LocationPrior | None, georeferenced_only: bool) -> Reach:
        """Raise AtlasError, because a position selects among the tiles of an atlas."""
        raise AtlasError("a position selects among the tiles of an atlas, and this is one map")

    def rankings(
        self, query_image: QueryImage, clock: StageClock, reach: Reach | None
    ) -> Iterator[TileRanking]:
        """Generate the ranking of one tile."""
        yield [(self._tile_id, 1.0)]

    def other_from_world(self, tile_id: str, other_id: str) -> Rigid3 | None:
        """Return the identity."""
        return Rigid3.identity()

    def may_be_same_pose(
        self, tile_id: str, pose: Localization, other_id: str, other_pose: Localization
    ) -> bool:
        """Return False. The belief of the map compares its own poses."""
        return False

    def with_tile(self, result: R, tile_id: str) -> R:
        """Return the result, with the tile if the map is a tile of an atlas."""
        return result if self._of is None else self._of.with_tile(result, tile_id)

    def with_provenance(
        self, result: R, camera: Camera | UncalibratedCamera | None, t_ns: int | None
    ) -> R:
        """Return the result with the identity of the map."""
        return self.with_tile(self.opened.with_provenance(result, camera, t_ns), self._tile_id)
