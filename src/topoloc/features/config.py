"""Define the settings of matching and of virtual views, without the code that reads them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

from topoloc.bounds import Between


@dataclass(frozen=True)
class MatchingConfig:
    """Hold the settings of descriptor matching."""

    method: Literal["exact", "flann"] = "exact"
    """`exact` compares every descriptor with every other. `flann` searches FLANN's KD-trees."""
    ratio: Annotated[float | None, Between(0, 1)] = None
    """A match must be nearer than `ratio` times its nearest rival. 0 accepts every nearest
    neighbour. Unset: the default of the feature type."""
    mutual: bool = True
    """Require that the query feature is also the nearest one of its train feature."""
    trees: Annotated[int, Between(1, 64)] = 5
    """FLANN: number of KD-trees."""
    checks: Annotated[int, Between(1, 1_000_000)] = 50
    """FLANN: number of leaves visited per query."""

    def resolved(self, ratio: float) -> MatchingConfig:
        """Return this configuration with `ratio`, unless its own is set."""
        return self if self.ratio is not None else replace(self, ratio=ratio)


@dataclass(frozen=True)
class VirtualViewConfig:
    """Hold the field of view of the virtual views. Tangents are of angles off the virtual camera's
    axis: 1 is 45 degrees ahead."""

    farthest: Annotated[float, Between(0.1, 10)] = 3.0
    """Largest tangent ahead. Walls farther ahead are too slanted to be seen well."""
    half_height: Annotated[float, Between(0.1, 10)] = 0.9
    """Largest tangent up and down."""
    nearest: Annotated[float, Between(0.1, 10)] = 1.5
    """A camera whose field of view begins beyond this tangent is too narrow and has no virtual
    views."""
    max_side_px: Annotated[int, Between(64, 4096)] = 700
    """Maximum length of the longer side of a virtual view."""
    margin_px: Annotated[int, Between(0, 1000)] = 8
    """Features nearer than this to the border of the rendered area are dropped."""
