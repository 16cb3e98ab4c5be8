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
    MIN_ALTERNATIVE_RATIO,
    LocalizationWithInliers,
    ResultWithInliers,
)
from topoloc.localization.fitted_weights import FittedWeights, load_fitted_weights
from topoloc.localization.map_context import MapContext
from topoloc.localization.provenance import Evidence
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
class TileResult:
    """Hold the result of a tile and each reported pose with its inliers.

    `is_exhaustive` is True after an exhaustive search. `similarity` is the tile's rank score.
    """

    tile_id: str
    result: Localization | NotLocalized
    poses: list[LocalizationWithInliers]
    is_exhaustive: bool
    similarity: float = 0.0

    @property
    def is_clear(self) -> bool:
        """Return whether the tile's pose is clear."""
        return isinstance(self.result, Localization) and (
            _weights(self.result).evidence.is_clear(_log_odds(self.result))
        )

    @property
    def localized(self) -> Localization | None:
        """Return the pose that an exhaustive search found, None if there is none."""
        found = self.result if self.is_exhaustive else None
        return found if isinstance(found, Localization) else None


@dataclass(frozen=True, eq=False)
class _Rival:
    """Hold a pose of another tile and the log-odds margin of the best pose over it."""

    tile_id: str
    pose: LocalizationWithInliers
    margin: float


def merge_tile_results(tiles: Tiles, results: Sequence[TileResult]) -> ResultWithInliers:
    """Merge the results of several tiles into one.

    The first reported pose of a tile represents it. If no tile localized the image, the most
    informative refusal is returned.

    Raises:
        AtlasError: no tile could be searched.
    """
    if not results:
        reason = next(iter(tiles.problems.values()), "no time")
        raise AtlasError(f"no tile of the atlas can be searched: {reason}")
    tile_id, result, poses = _merge(tiles, results)
    return tiles.with_tile(result, tile_id), poses


def _merge(
    tiles: Tiles, results: Sequence[TileResult]
) -> tuple[str, Localization | NotLocalized, list[LocalizationWithInliers]]:
    """Return the tile of the result, the result, and its reported poses."""
    if len(results) == 1:
        return results[0].tile_id, results[0].result, results[0].poses
    localized = [
        (one, found, _rivals(tiles, one, found, results))
        for one in results
        if (found := one.localized) is not None
    ]
    if not localized:
        return _best_refusal(results)
    best, found, rivals = max(
        localized, key=lambda one: min((rival.margin for rival in one[2]), default=math.inf)
    )
    if not rivals:
        return best.tile_id, found, best.poses
    others = 1.0 / max(found.probability, 1e-6) - 1.0
    others += sum(math.exp(-rival.margin) for rival in rivals)
    if all(rival.margin >= _weights(found).rivals.lead for rival in rivals):
        found = replace(found, probability=1.0 / (1.0 + others))
        return best.tile_id, found, [(found, seen) for _, seen in best.poses]
    return best.tile_id, *_ambiguous_result(best, found, rivals, others)


def is_negligible_rival(evidence: Evidence, features: str, answer: Localization) -> bool:
    """Return whether a pose with this evidence is too improbable to be reported as an
    alternative."""
    weights = load_fitted_weights(features)
    log_odds = weights.log_odds(evidence)
    by = _log_odds_margin(answer, features, log_odds, weights.rivals.score(evidence, log_odds))
    return by > -math.log(MIN_ALTERNATIVE_RATIO)


def _rivals(
    tiles: Tiles, one: TileResult, found: Localization, results: Sequence[TileResult]
) -> list[_Rival]:
    """Return the poses of other tiles that differ from the pose of this tile."""
    rivals = list[_Rival]()
    for other in (other for other in results if other is not one):
        for pose, seen in other.poses:
            if not tiles.may_be_same_pose(one.tile_id, found, other.tile_id, pose):
                scores = _log_odds(pose), _rival_score(pose)
                margin = _log_odds_margin(found, pose.provenance.features, *scores)
                rivals.append(_Rival(other.tile_id, (pose, seen), margin))
    return rivals


def _ambiguous_result(
    best: TileResult, found: Localization, rivals: Sequence[_Rival], others: float
) -> tuple[NotLocalized, list[LocalizationWithInliers]]:
    """Return an ambiguous result with the probability of each alternative."""
    shares = [(1.0 / (1.0 + others), best.tile_id, best.poses[0])]
    shares += [(math.exp(-one.margin) / (1.0 + others), one.tile_id, one.pose) for one in rivals]
    probable = sorted(
        (one for one in shares if one[0] >= MIN_ALTERNATIVE_RATIO * shares[0][0]),
        key=lambda one: -one[0],
    )
    alternatives = tuple(
        Alternative(pose.world_from_cam, probability, pose.node_id, pose.geopose, tile_id)
        for probability, tile_id, (pose, _) in probable
    )
    refusal = NotLocalized(
        "ambiguous",
        found.candidates,
        found.num_matches,
        found.num_inliers,
        {},
        f"as much like tile {alternatives[1].tile} as like tile {alternatives[0].tile}",
        alternatives,
        found.provenance,
        found.seen_camera,
    )
    return refusal, [
        (replace(pose, probability=probability), seen) for probability, _, (pose, seen) in probable
    ]


def _best_refusal(
    results: Sequence[TileResult],
) -> tuple[str, NotLocalized, list[LocalizationWithInliers]]:
    """Return the most informative refusal: one with alternatives, or with the most inliers."""
    best, result = max(
        [(one, result) for one in results if isinstance(result := one.result, NotLocalized)],
        key=lambda one: (
            one[0].is_exhaustive,
            one[1].reason == "ambiguous",
            one[1].num_inliers,
            one[0].similarity,
        ),
    )
    return best.tile_id, result, best.poses


def _log_odds_margin(a: Localization, features: str, log_odds: float, rival_score: float) -> float:
    """Return the log-odds margin of a pose over one with these log-odds and this score.

    It is the difference of rival scores, which separate similar places, if both use the same
    feature type. Otherwise, or for virtual views, it is the difference of log-odds.
    """
    is_alike = features == a.provenance.features
    margin = _rival_score(a) - rival_score if is_alike else math.nan
    return _log_odds(a) - log_odds if math.isnan(margin) else margin


def _rival_score(result: Localization) -> float:
    """Return the rival score of a pose, as in `belief.log_odds_margin`."""
    if result.evidence is None:
        return _log_odds(result)
    return _weights(result).rivals.score(result.evidence, _log_odds(result))


def _log_odds(result: Localization) -> float:
    """Return the log-odds of the pose against "not in the map"."""
    if result.evidence is None:
        return math.log(max(result.probability, 1e-9) / max(1.0 - result.probability, 1e-9))
    return _weights(result).log_odds(result.evidence)


def _weights(result: Localization) -> FittedWeights:
    return load_fitted_weights(result.provenance.features)
