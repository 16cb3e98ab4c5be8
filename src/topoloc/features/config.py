"""Define the settings of matching, without the code that reads them."""

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

    @staticmethod
    def nearest() -> MatchingConfig:
        """Return the settings that match each feature with its nearest one."""
        return MatchingConfig(ratio=0.0, mutual=False)

    def resolved(self, ratio: float) -> MatchingConfig:
        """Return this configuration with `ratio`, unless its own is set."""
        return self if self.ratio is not None else replace(self, ratio=ratio)
