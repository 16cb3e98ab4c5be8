"""Settings and limits of the search in an atlas."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from topoloc.bounds import Between


@dataclass(frozen=True)
class AtlasConfig:
    """Configure how many tiles are searched."""

    num_glanced: Annotated[int, Between(1, 100_000)] = 8
    """Maximum number of tiles searched coarse only, by retrieval. The search stops at a clear
    pose."""
    num_asked: Annotated[int, Between(1, 10_000)] = 3
    """Maximum number of tiles searched exhaustively, until one localizes the image."""

    num_ranked: ClassVar[int] = 64
    """Number of tiles ranked by the index. No others are searched."""
    min_ranking_margin: ClassVar[float] = 0.15
    """Minimum similarity margin of the best tile for an immediate exhaustive search. If no tile has
    it, the next feature type ranks them."""
    num_coarse_first: ClassVar[int] = 2
    """Maximum number of tiles searched coarse only before the next feature type ranks them."""
    max_similarity_gap: ClassVar[float] = 0.25
    """Tiles whose similarity is lower than the best tile's by more than this are not searched."""
    min_similarity: ClassVar[float] = 0.33
    """Similarity that any place reaches. After the first tile, less similar ones are searched
    exhaustively only if the coarse search found a pose."""
    max_rival_gap: ClassVar[float] = 0.1
    """Tiles whose similarity is within this of the tile that localized the image are checked for a
    rival pose."""
    num_rivals: ClassVar[int] = 2
    """Maximum number of these similar tiles that are checked."""
