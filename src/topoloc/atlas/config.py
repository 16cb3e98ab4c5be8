"""Settings of the search in an atlas."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from topoloc.bounds import AtLeast, Between


@dataclass(frozen=True)
class AtlasConfig:
    """Configure the selection and order of tiles and the conditions to stop."""

    num_ranked: Annotated[int, Between(1, 1_000_000)] = 64
    """Number of tiles ranked by the index. No others are searched."""
    settled_gap: Annotated[float, Between(0, 2)] = 0.15
    """Minimum similarity margin of the best tile for an immediate exhaustive search. If no tile has
    it, the next feature type ranks them."""
    num_glanced_first: Annotated[int, Between(0, 100_000)] = 2
    """Maximum number of tiles searched coarse only before the next feature type ranks them. The
    search stops at a clear pose."""
    hopeless_gap: Annotated[float, Between(0, 2)] = 0.25
    """Tiles whose similarity is lower than the best tile's by more than this are not searched."""
    num_glanced: Annotated[int, Between(1, 100_000)] = 8
    """Maximum number of tiles searched coarse only with the last feature type, including earlier
    ones. The search stops at a clear pose."""
    num_asked: Annotated[int, Between(1, 10_000)] = 3
    """Maximum number of tiles searched exhaustively, until one localizes the image."""
    least_likeness: Annotated[float, Between(-1, 2)] = 0.33
    """Similarity that any place reaches. After the first tile, less similar ones are searched
    exhaustively only if the coarse search found a pose."""
    alike_gap: Annotated[float, Between(0, 2)] = 0.1
    """Tiles whose similarity is within this of the tile that localized the image are checked for a
    rival pose."""
    num_alike: Annotated[int, Between(0, 1000)] = 2
    """Maximum number of these similar tiles that are checked."""
    max_ms: Annotated[float | None, AtLeast(0)] = None
    """Time limit in milliseconds, after which no further tile is searched (None: no limit)."""
