"""Add up over a stream whether its colours are those of the map, or of another floor.

One image may not decide it. Images of other places are nearly independent, so the log-odds of their
appearances add up. Images of one place count once.
"""

from __future__ import annotations

import math

import numpy as np

from topoloc.geometry.rigid import Rigid3
from topoloc.localization.exact.appearance import load_appearance_weights
from topoloc.localization.result import Localization, NotLocalized


class FloorEvidence:
    """Hold the log-odds of the appearances at the last places of a stream. `has_look_alikes`: see
    `MapConfig.look_alike_floors`."""

    def __init__(self, has_look_alikes: bool) -> None:
        self._has_look_alikes = has_look_alikes
        self._seen = list[tuple[Rigid3 | None, float]]()

    def add(self, result: Localization | NotLocalized) -> None:
        """Add the result of an image, unless it is of the last place. Successive refusals are of
        one place."""
        max_places, min_metres, min_radians, max_log_odds = 5, 0.5, 0.5, 4.0
        pose = result.world_from_cam if isinstance(result, Localization) else None
        is_known = self._seen and _is_same(self._seen[-1][0], pose, min_metres, min_radians)
        if result.appearance is None or is_known:
            return
        odds = result.appearance / max(1.0 - result.appearance, 1e-9)
        log_odds = float(np.clip(math.log(max(odds, 1e-9)), -max_log_odds, max_log_odds))
        self._seen = [*self._seen, (pose, log_odds)][-max_places:]

    @property
    def is_sure(self) -> bool:
        """Return whether the places so far are of this floor. Three places must say so more
        clearly. In a map with look-alike floors fewer do not suffice."""
        weights, is_enough = load_appearance_weights(), len(self._seen) >= 3
        least = math.log(weights.floor_odds[self._has_look_alikes])
        least += weights.places_log_odds if is_enough else 0.0
        seen = sum(log_odds for _, log_odds in self._seen)
        return seen >= least and (is_enough or not self._has_look_alikes)


def _is_same(a: Rigid3 | None, b: Rigid3 | None, metres: float, radians: float) -> bool:
    if a is None or b is None:
        return a is b
    return a.is_same(b, metres, radians)
