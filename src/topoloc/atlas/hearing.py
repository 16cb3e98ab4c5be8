"""What the tiles of an atlas have said of one picture so far."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

from topoloc.atlas.open_maps import OpenedMap
from topoloc.atlas.verdict import Heard, is_far_behind
from topoloc.localization.asking import Asking
from topoloc.localization.query import Picture
from topoloc.localization.result import Localization

Ranking = list[tuple[str, float]]
"""Tiles with the likeness of their best place, the likeliest first."""


@dataclass(eq=False)
class Hearing:
    """One picture; others may be asked until the deadline (of `time.perf_counter`)."""

    picture: Picture
    deadline: float
    ranking: Ranking = field(default_factory=list)
    heard: dict[str, Heard] = field(default_factory=dict)
    begun: dict[str, tuple[OpenedMap, Asking]] = field(default_factory=dict)
    """The questions that tiles were asked, each with the map as it was open then: one that was
    closed since is asked anew."""

    @property
    def is_late(self) -> bool:
        return time.perf_counter() > self.deadline

    @property
    def left_ms(self) -> float | None:
        """Milliseconds that are left; None where there is no limit."""
        return (
            None
            if self.deadline == float("inf")
            else max(1.0, 1e3 * (self.deadline - time.perf_counter()))
        )

    @property
    def is_settled(self) -> bool:
        """Is a pose so well founded that the tile itself asked no further?"""
        return any(one.is_clear for one in self.heard.values())

    @property
    def answers(self) -> list[Heard]:
        """The tiles that vouch for a pose when they are asked by all means."""
        return [
            one
            for one in self.heard.values()
            if one.is_full and isinstance(one.result, Localization)
        ]

    def may_be_rival(self, asking: Asking) -> bool:
        """May a further tile's pose come near one of the answers? Where it is known about where the
        camera is in that tile, it is asked."""
        if asking.prior is not None:
            return True
        evidence = asking.best_case(
            min(self.begun[one.tile.tile_id][1].least_inliers for one in self.answers)
        )
        poses = [one.result for one in self.answers if isinstance(one.result, Localization)]
        return evidence is not None and not all(
            is_far_behind(evidence, asking.features, pose) for pose in poses
        )

    def was_asked(self, tile_id: str) -> bool:
        """By all means?"""
        return tile_id in self.heard and self.heard[tile_id].is_full

    def promise(self, ranked: tuple[str, float]) -> tuple[float, float]:
        """Which of several tiles is asked first: the one with the likeliest pose at a glance, then
        the one that looks most like the picture."""
        known = self.heard.get(ranked[0])
        return max((one.probability for one in known.named), default=0.0) if known else 0.0, ranked[
            1
        ]
