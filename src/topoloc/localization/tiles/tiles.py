"""Hold the tiles that a localizer searches, and merge their results for one image.

A map file is searched as an atlas of one tile. Each tile ranks only its own poses. A pose is
reported only if it leads every pose of every other searched tile by the margin required within one
map (`belief.py`). Otherwise the image is ambiguous, and the alternatives name their tiles. If the
transform between two tiles is known, equal poses are not rivals.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from topoloc.errors import AtlasError, MapError
from topoloc.geometry.camera import Camera, UncalibratedCamera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.answer import (
    Answer,
    LocalizationWithInliers,
    ResultWithInliers,
    refuse,
)
from topoloc.localization.belief import select_probable, share_probability
from topoloc.localization.map_context import MapContext
from topoloc.localization.query import QueryImage, StageClock
from topoloc.localization.result import Alternative, Localization, NotLocalized, R

if TYPE_CHECKING:
    from topoloc.atlas.location_prior import LocationPrior

TileRanking = list[tuple[str, float]]
"""Tiles with the similarity of their best node, the most similar first."""
Reach = Mapping[str, Rigid3 | None]
"""Tiles that may be searched, each with the prior pose (world_from_cam) in its world or None."""


class Tiles:
    """Search one map as an atlas of one tile. `atlas_tiles.py` searches several.

    If the map is a tile of an atlas, `of` and `tile_id` name it in the results. `ids` holds the ids
    of all tiles, and `problems` the reasons for those that cannot be searched. The index cannot
    rank the tiles in `unranked`.
    """

    def __init__(self, opened: MapContext, of: Tiles | None = None, tile_id: str = "") -> None:
        self._opened, self._of, self._tile_id = opened, of, tile_id
        self.ids, self.problems, self.unranked = [tile_id], dict[str, str](), frozenset[str]()

    @property
    def opened(self) -> MapContext:
        """Return the only map. Raises AtlasError: this is an atlas."""
        return self._opened

    def alone(self, tile_id: str, opened: MapContext) -> Tiles:
        """Return a tile, whose map is open, as the only one."""
        return self

    @contextmanager
    def use(self, tile_id: str) -> Iterator[MapContext]:
        """Keep the map of a tile open for the context.

        Raises:
            AtlasError: there is no such tile.
            MapError: the map cannot be read.
        """
        if tile_id != self._tile_id:
            raise AtlasError(f"a map has no tile {tile_id[:80]!r}: tiles are parts of an atlas")
        yield self._opened

    def can_search(self, tile_id: str) -> bool:
        """Return whether a tile had no problem in the last seconds."""
        return True

    def report(self, tile_id: str, error: MapError) -> None:
        """Record that a tile cannot be searched. Raises the error if no other tile is left."""
        raise error

    def in_reach(self, near: LocationPrior | None, georeferenced_only: bool) -> Reach:
        """Return the tiles in reach of a position. Raises AtlasError: the prior does not fit."""
        raise AtlasError("a position selects among the tiles of an atlas, and this is one map")

    def rankings(
        self, query_image: QueryImage, clock: StageClock, reach: Reach | None
    ) -> Iterator[TileRanking]:
        """Generate rankings of the tiles, each with one more feature type."""
        yield [(self._tile_id, 1.0)]

    def other_from_world(self, tile_id: str, other_id: str) -> Rigid3 | None:
        """Return the transform from the world of a tile to that of another, None if unknown."""
        return Rigid3.identity()

    def may_be_same_pose(
        self, tile_id: str, pose: Localization, other_id: str, other_pose: Localization
    ) -> bool:
        """Return whether poses of two tiles may be the same."""
        return False  # the belief of a map compares its own poses

    def with_tile(self, result: R, tile_id: str) -> R:
        """Return the result of a tile's map with the tile's id and its pose in the atlas."""
        return result if self._of is None else self._of.with_tile(result, tile_id)

    def with_provenance(
        self, result: R, camera: Camera | UncalibratedCamera | None, t_ns: int | None
    ) -> R:
        """Return a result that no map computed with all that is known of its source."""
        return self.with_tile(self.opened.with_provenance(result, camera, t_ns), self._tile_id)


def ranking_margin(ranking: TileRanking) -> float:
    """Return the similarity margin of the best tile over the second, infinite for a single tile."""
    return ranking[0][1] - ranking[1][1] if len(ranking) > 1 else float("inf")


@dataclass(frozen=True, eq=False)
class TileAnswer:
    """Hold the answer of a tile.

    `is_exhaustive` is True after an exhaustive search. `similarity` is the tile's rank score.
    """

    tile_id: str
    answer: Answer
    is_exhaustive: bool
    similarity: float = 0.0

    @property
    def is_clear(self) -> bool:
        """Return whether the tile's pose is clear."""
        best, search = self.answer.best, self.answer.search
        if self.answer.pose is None or best is None:
            return False
        return search.weights.evidence.is_clear(best.log_odds)

    @property
    def localized(self) -> Localization | None:
        """Return the pose that an exhaustive search found, None if there is none."""
        return self.answer.pose if self.is_exhaustive else None


@dataclass(frozen=True, eq=False)
class _Rival:
    """Hold a pose of another tile and the log-odds margin of the best pose over it."""

    tile_id: str
    pose: LocalizationWithInliers
    margin: float


def merge_answers(tiles: Tiles, answers: Sequence[TileAnswer]) -> ResultWithInliers:
    """Merge the answers of several tiles into one result.

    A pose must lead those of all other tiles by the margin that is required within a map. If no
    tile localized the image, the most informative refusal is returned.

    Raises:
        AtlasError: no tile could be searched.
    """
    if not answers:
        reason = next(iter(tiles.problems.values()), "no time")
        raise AtlasError(f"no tile of the atlas can be searched: {reason}")
    localized = [
        (one, pose, _rivals(tiles, one, pose, answers))
        for one in answers
        if (pose := one.localized) is not None
    ]
    if not localized:
        refused = [one for one in answers if one.answer.pose is None]
        best = max(refused or answers, key=_num_facts)
        return tiles.with_tile(best.answer.result, best.tile_id), best.answer.poses
    best, pose, rivals = max(
        localized, key=lambda one: min((rival.margin for rival in one[2]), default=math.inf)
    )
    if not rivals:
        return tiles.with_tile(pose, best.tile_id), best.answer.poses
    margins = [rival.margin for rival in rivals]
    shares = share_probability(1.0 / max(pose.probability, 1e-6) - 1.0, margins)
    if min(margins) >= best.answer.search.weights.rivals.lead:
        pose = replace(pose, probability=shares[0])
        return tiles.with_tile(pose, best.tile_id), [(pose, best.answer.poses[0][1])]
    return _ambiguous_result(tiles, best, rivals, shares)


def _rivals(
    tiles: Tiles, one: TileAnswer, pose: Localization, answers: Sequence[TileAnswer]
) -> list[_Rival]:
    """Return the poses of other tiles that differ from the pose of this tile."""
    rivals = list[_Rival]()
    for other in (other for other in answers if other is not one):
        for named, hypothesis in zip(other.answer.poses, other.answer.hypotheses, strict=True):
            if not tiles.may_be_same_pose(one.tile_id, pose, other.tile_id, named[0]):
                margin = one.answer.margin_over(other.answer.search, hypothesis)
                rivals.append(_Rival(other.tile_id, named, margin))
    return rivals


def _ambiguous_result(
    tiles: Tiles, best: TileAnswer, rivals: Sequence[_Rival], shares: list[float]
) -> ResultWithInliers:
    """Return an ambiguous result with the probability of each alternative."""
    found = [(best.tile_id, best.answer.poses[0]), *((one.tile_id, one.pose) for one in rivals)]
    probable = select_probable(found, shares)
    alternatives = tuple(
        Alternative(
            *(pose.world_from_cam, probability, pose.node_id, pose.geopose, tile_id),
            covariance=pose.covariance,
        )
        for (tile_id, (pose, _)), probability in probable
    )
    detail = f"as much like tile {alternatives[1].tile} as like tile {alternatives[0].tile}"
    pose = best.answer.poses[0][0]
    refusal = refuse(best.answer.search, pose, "ambiguous", detail)
    refusal = replace(refusal, alternatives=alternatives)
    poses = [
        (replace(pose, probability=probability), seen)
        for (_, (pose, seen)), probability in probable
    ]
    return tiles.with_tile(refusal, best.tile_id), poses


def _num_facts(one: TileAnswer) -> tuple[bool, bool, int, float]:
    """Return the sort key of refusals: the most informative one is the largest."""
    result = one.answer.result
    is_ambiguous = isinstance(result, NotLocalized) and result.reason == "ambiguous"
    return one.is_exhaustive, is_ambiguous, result.num_inliers, one.similarity
