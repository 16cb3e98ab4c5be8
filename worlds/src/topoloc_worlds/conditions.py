"""Times of day and weather: a condition is a parameter of a world, so that the same camera pose is
true under each of them."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

from topoloc.errors import TopolocError


@dataclass(frozen=True)
class Condition:
    """Define light and weather of one visit of a place.

    Attributes:
        daylight: light of the sky, as a share of a clear noon.
        sun: whether there is direct sunlight, with shadows.
        lamps: share of the lamps that are lit. The seed of the world selects them.
        wet: whether the ground outside is wet and reflects.
        rain: falling drops, in drops a picture of 640x400.
        visibility: distance (metres) at which 1/e of the light is left.
    """

    name: str
    daylight: float
    sun: bool = False
    lamps: float = 0.0
    wet: bool = False
    rain: int = 0
    visibility: float = inf


CONDITIONS = {
    condition.name: condition
    for condition in (
        Condition("day", daylight=1.0, sun=True, lamps=0.3),
        Condition("evening", daylight=0.01, lamps=1.0),
        Condition("night", daylight=0.0, lamps=0.4),
        Condition("cloudy", daylight=0.35, lamps=0.3, visibility=900.0),
        Condition("rain", daylight=0.2, lamps=0.5, wet=True, rain=250, visibility=220.0),
    )
}
ALIASES = {"clear": "day"}


def find_condition(name: str) -> Condition:
    """A condition by its name. Raises TopolocError, with the list of names."""
    try:
        return CONDITIONS[ALIASES.get(name, name)]
    except KeyError:
        raise TopolocError(
            f"unknown condition {name!r}; conditions: {', '.join([*CONDITIONS, *ALIASES])}"
        ) from None
