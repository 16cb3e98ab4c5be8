"""Collect the results of an atlas's tiles for one query image."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

from topoloc.atlas.map_cache import CachedMap
from topoloc.atlas.tile_results import TileResult, is_negligible_rival
from topoloc.localization.query import QueryImage
from topoloc.localization.query_session import QuerySession
from topoloc.localization.result import Localization

TileRanking = list[tuple[str, float]]
"""Tiles with the similarity of their best node, likeliest first."""


@dataclass(eq=False)
class AtlasQuerySession:
    """Hold the state of one query. Tiles are searched until the deadline (`time.perf_counter`)."""

    query_image: QueryImage
    deadline: float
    ranking: TileRanking = field(default_factory=list)
    tile_results: dict[str, TileResult] = field(default_factory=dict)
    map_sessions: dict[str, tuple[CachedMap, QuerySession]] = field(default_factory=dict)
    """Query sessions by tile, each with its open map. If the map was closed since, a new session
    starts."""

    @property
    def is_past_deadline(self) -> bool:
        """Return whether the deadline has passed."""
        return time.perf_counter() > self.deadline

    @property
    def remaining_ms(self) -> float | None:
        """Return the milliseconds left (at least 1), None without a deadline."""
        return (
            None
            if self.deadline == float("inf")
            else max(1.0, 1e3 * (self.deadline - time.perf_counter()))
        )

    @property
    def is_settled(self) -> bool:
        """Return whether a tile found a clear pose."""
        return any(one.is_clear for one in self.tile_results.values())

    @property
    def localized_tiles(self) -> list[TileResult]:
        """Return the tiles that localized the image in an exhaustive search."""
        return [
            one
            for one in self.tile_results.values()
            if one.is_exhaustive and isinstance(one.result, Localization)
        ]

    def can_be_rival(self, query_session: QuerySession) -> bool:
        """Return whether a further tile's pose may rival one of the found poses.

        It is always True if the prior pose in that tile is known.
        """
        if query_session.prior is not None:
            return True
        evidence = query_session.compute_best_case_evidence(
            min(
                self.map_sessions[one.tile.tile_id][1].min_rival_inliers
                for one in self.localized_tiles
            )
        )
        poses = [one.result for one in self.localized_tiles if isinstance(one.result, Localization)]
        return evidence is not None and not all(
            is_negligible_rival(evidence, query_session.features, pose) for pose in poses
        )

    def is_fully_queried(self, tile_id: str) -> bool:
        """Return whether the tile was searched exhaustively."""
        return tile_id in self.tile_results and self.tile_results[tile_id].is_exhaustive

    def query_priority(self, ranked: tuple[str, float]) -> tuple[float, float]:
        """Return the sort key of a tile: first the probability of its coarse pose, then its
        similarity."""
        known = self.tile_results.get(ranked[0])
        return max((one.probability for one in known.named), default=0.0) if known else 0.0, ranked[
            1
        ]
