"""What the tiles of an atlas have said of one picture so far."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

from topoloc.atlas.map_cache import CachedMap
from topoloc.atlas.tile_results import TileResult, is_negligible_rival
from topoloc.localization.query import QueryImage
from topoloc.localization.query_session import QuerySession
from topoloc.localization.result import Localization

TileRanking = list[tuple[str, float]]
"""Tiles with the likeness of their best place, the likeliest first."""


@dataclass(eq=False)
class AtlasQuerySession:
    """One picture; others may be asked until the deadline (of `time.perf_counter`)."""

    query_image: QueryImage
    deadline: float
    ranking: TileRanking = field(default_factory=list)
    tile_results: dict[str, TileResult] = field(default_factory=dict)
    map_sessions: dict[str, tuple[CachedMap, QuerySession]] = field(default_factory=dict)
    """The questions that tiles were asked, each with the map as it was open then: one that was
    closed since is asked anew."""

    @property
    def is_past_deadline(self) -> bool:
        return time.perf_counter() > self.deadline

    @property
    def remaining_ms(self) -> float | None:
        """Milliseconds that are left; None where there is no limit."""
        return (
            None
            if self.deadline == float("inf")
            else max(1.0, 1e3 * (self.deadline - time.perf_counter()))
        )

    @property
    def is_settled(self) -> bool:
        """Is a pose so well founded that the tile itself asked no further?"""
        return any(one.is_clear for one in self.tile_results.values())

    @property
    def localized_tiles(self) -> list[TileResult]:
        """The tiles that vouch for a pose when they are asked by all means."""
        return [
            one
            for one in self.tile_results.values()
            if one.is_exhaustive and isinstance(one.result, Localization)
        ]

    def can_be_rival(self, query_session: QuerySession) -> bool:
        """May a further tile's pose come near one of the answers? Where it is known about where the
        camera is in that tile, it is asked."""
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
        """By all means?"""
        return tile_id in self.tile_results and self.tile_results[tile_id].is_exhaustive

    def query_priority(self, ranked: tuple[str, float]) -> tuple[float, float]:
        """Which of several tiles is asked first: the one with the likeliest pose at a glance, then
        the one that looks most like the picture."""
        known = self.tile_results.get(ranked[0])
        return max((one.probability for one in known.named), default=0.0) if known else 0.0, ranked[
            1
        ]
