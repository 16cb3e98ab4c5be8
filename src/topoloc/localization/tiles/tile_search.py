"""Search one image in tiles: select them, order them, and decide when to stop.

The image's features are extracted once for all tiles. The index ranks the tiles with the cheapest
feature type. A tile with a large margin is searched exhaustively at once. Otherwise the likeliest
tiles are searched coarse only, by retrieval, until a pose is clear. If none is, the next feature
type ranks the tiles and more are searched coarse only. The most promising ones are then searched
exhaustively until one localizes the image.

Last, similar tiles are checked for a rival pose (`tile_results.py`), because perceptual aliasing
grows with the number of places. They are searched like similar places within a map. A tile is
skipped if far fewer of the image's strongest features agree with it.

One map is one tile with an infinite margin: it is searched exhaustively at once.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import Literal

from topoloc.atlas.config import AtlasConfig
from topoloc.errors import AtlasError, MapError, ObjectStoreError
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.map_context import MapContext
from topoloc.localization.query import QueryImage, StageClock
from topoloc.localization.query_session import QuerySession
from topoloc.localization.result import Localization
from topoloc.localization.result_decision import ResultWithInliers
from topoloc.localization.search import Trace
from topoloc.localization.tiles.tile_results import (
    TileResult,
    is_negligible_rival,
    merge_tile_results,
)
from topoloc.localization.tiles.tiles import Reach, TileRanking, Tiles

SearchMode = Literal["exhaustive", "coarse", "rival"]
"""How a tile is searched: exhaustive, coarse only, or coarse only if it may rival a found pose."""


@dataclass(eq=False)
class TileSearch:
    """Hold the state of one query. Tiles are searched until the deadline (`time.perf_counter`).

    `reach` holds the tiles that may be searched, None for all. `sessions` holds the query session
    of each tile with its open map. If the map was closed since, a new session starts.
    """

    tiles: Tiles
    config: AtlasConfig
    query_image: QueryImage
    deadline: float
    reach: Reach | None = None
    trace: Trace | None = None
    clock: StageClock = field(default_factory=StageClock)
    ranking: TileRanking = field(default_factory=list)
    results: dict[str, TileResult] = field(default_factory=dict)
    sessions: dict[str, tuple[MapContext, QuerySession]] = field(default_factory=dict)

    def search_tile(
        self,
        tile_id: str,
        similarity: float = 1.0,
        mode: SearchMode = "exhaustive",
        prior: Rigid3 | None = None,
    ) -> None:
        """Search the image in one tile. If it cannot be read, it is recorded in `tiles.problems`.

        Raises:
            ObjectStoreError: the object store of the tile does not respond.
            MapError: the map cannot be read, and no other tile is left.
        """
        if tile_id in self.tiles.problems:
            self.results.pop(tile_id, None)
            return
        if prior is None and self.reach is not None:
            prior = self.reach.get(tile_id)
        try:
            with self.tiles.use(tile_id) as opened:
                before, session = self.sessions.get(tile_id, (None, None))
                if session is None or before is not opened:
                    session = opened.query_session(
                        self.query_image, prior, self._remaining_ms, self.trace
                    )
                self.sessions[tile_id] = opened, session
                if mode == "rival" and not self._can_be_rival(session):
                    return
                is_exhaustive = mode == "exhaustive"
                result, poses = (
                    session.localize_exhaustive()
                    if is_exhaustive
                    else session.localize_coarse_only()
                )
        except ObjectStoreError:  # the tile is fine, but its result is unknown
            raise
        except MapError as error:
            self.results.pop(tile_id, None)
            self.tiles.report(tile_id, error)
            return
        self.results[tile_id] = TileResult(tile_id, result, poses, is_exhaustive, similarity)

    def search_all(self) -> None:
        """Search tiles until one localizes the image, then the similar tiles."""
        num_coarse = self.config.num_coarse_first
        for ranking in self.tiles.rankings(self.query_image, self.clock, self.reach):
            self.ranking = ranking
            if ranking_margin(self._readable(ranking)) < self.config.min_ranking_margin:
                self._search_coarse_only(num_coarse)
            if self._has_clear_pose or self._is_past_deadline:
                break
        else:
            if ranking_margin(self._readable(self.ranking)) < self.config.min_ranking_margin:
                self._search_coarse_only(self.config.num_glanced)
        hopeful = self._candidates()
        for number in range(self.config.num_asked):
            left = [one for one in self._readable(hopeful) if not self._is_exhausted(one[0])]
            if number:
                left = [one for one in left if self._is_promising(one)]
            if not left or self._localized or (self.results and self._is_past_deadline):
                break
            self.search_tile(*max(left, key=self._priority))
        while not self.results and (left := self._readable(self.ranking)):
            self.search_tile(*left[0])  # the likely tiles cannot be read
        self._search_similar_tiles()

    def outcome(self) -> ResultWithInliers:
        """Return the result of all searched tiles.

        Raises:
            AtlasError: no tile could be searched.
        """
        if not self.results:
            reason = next(iter(self.tiles.problems.values()), "no time")
            raise AtlasError(f"no tile of the atlas can be searched: {reason}")
        tile_id, result, poses = merge_tile_results(self.tiles, list(self.results.values()))
        result = replace(self.tiles.with_tile(result, tile_id), times_ms=self._times_ms())
        return result, poses

    def _search_coarse_only(self, num_tiles: int) -> None:
        """Search the likeliest tiles coarse only, until a pose is clear."""
        for tile_id, similarity in self._candidates()[:num_tiles]:
            if self._has_clear_pose or self._is_past_deadline:
                return
            if tile_id not in self.results:
                self.search_tile(tile_id, similarity, "coarse")

    def _search_similar_tiles(self) -> None:
        """Search tiles that are about as similar to the image as the one that localized it.

        A tile is searched coarse only, if a quick test does not exclude it as a rival.
        """
        if not self._localized:
            return
        least = min(one.similarity for one in self._localized) - self.config.max_rival_gap
        alike = [one for one in self.ranking if one[1] >= least and one[0] not in self.results]
        for tile_id, similarity in alike[: self.config.num_rivals]:
            if not self._is_past_deadline:
                self.search_tile(tile_id, similarity, "rival")
        for one in [
            one for one in self.results.values() if one.is_clear and not one.is_exhaustive
        ]:  # one of them may hold the true pose
            self.search_tile(one.tile_id, one.similarity)

    def _candidates(self) -> TileRanking:
        """Return the tiles that are nearly as similar to the image as the best one."""
        ranking = self._readable(self.ranking)
        return [
            one
            for one in ranking
            if one[1] >= ranking[0][1] - self.config.max_similarity_gap
            or one[0] in self.tiles.unranked
        ]

    def _is_promising(self, ranked: tuple[str, float]) -> bool:
        """Return whether the coarse search found a pose or the tile is similar enough to the image.

        Tiles that cannot be ranked are always promising.
        """
        return (
            self._priority(ranked) >= (0.0, self.config.min_similarity)
            or ranked[0] in self.tiles.unranked
        )

    def _can_be_rival(self, session: QuerySession) -> bool:
        """Return whether a further tile's pose may rival one of the found poses.

        It is always True if the prior pose in that tile is known.
        """
        if session.prior is not None:
            return True
        least = min(self.sessions[one.tile_id][1].min_rival_inliers for one in self._localized)
        evidence = session.compute_best_case_evidence(least)
        poses = [one.result for one in self._localized if isinstance(one.result, Localization)]
        return evidence is not None and not all(
            is_negligible_rival(evidence, session.features, pose) for pose in poses
        )

    def _readable(self, ranking: TileRanking) -> TileRanking:
        """Return the ranking without unreadable tiles."""
        return [one for one in ranking if one[0] not in self.tiles.problems]

    def _is_exhausted(self, tile_id: str) -> bool:
        return tile_id in self.results and self.results[tile_id].is_exhaustive

    def _priority(self, ranked: tuple[str, float]) -> tuple[float, float]:
        """Return the sort key of a tile: first the probability of its coarse pose, then its
        similarity."""
        known = self.results.get(ranked[0])
        found = [one.probability for one, _ in known.poses] if known else []
        return max(found, default=0.0), ranked[1]

    @property
    def _localized(self) -> list[TileResult]:
        """Return the tiles that localized the image in an exhaustive search."""
        return [
            one
            for one in self.results.values()
            if one.is_exhaustive and isinstance(one.result, Localization)
        ]

    @property
    def _has_clear_pose(self) -> bool:
        return any(one.is_clear for one in self.results.values())

    @property
    def _is_past_deadline(self) -> bool:
        return time.perf_counter() > self.deadline

    @property
    def _remaining_ms(self) -> float | None:
        """Return the milliseconds left (at least 1), None without a deadline."""
        if self.deadline == float("inf"):
            return None
        return max(1.0, 1e3 * (self.deadline - time.perf_counter()))

    def _times_ms(self) -> dict[str, float]:
        """Return the milliseconds of each stage, summed over all tiles.

        `tiles` is the ranking of tiles, without feature extraction.
        """
        total = self.clock.times_ms()
        for _, session in self.sessions.values():
            for stage, ms in session.times_ms.items():
                if stage != "total":
                    total[stage] = total.get(stage, 0.0) + ms
        return total


def ranking_margin(ranking: TileRanking) -> float:
    """Return the similarity margin of the best tile over the second, infinite for a single tile."""
    return ranking[0][1] - ranking[1][1] if len(ranking) > 1 else float("inf")
