"""How the tiles of an atlas are asked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from topoloc.bounds import AtLeast, Between


@dataclass(frozen=True)
class AtlasConfig:
    """Which tiles are asked, in which order, and when it is enough."""

    num_ranked: Annotated[int, Between(1, 1_000_000)] = 64
    """Tiles that the index names, the likeliest first; no others are asked."""
    settled_gap: Annotated[float, Between(0, 2)] = 0.15
    """A tile whose best place is so much more like the picture than any other tile's is asked by
    all means at once; and where no tile leads so by one kind of features, the next kind ranks
    them."""
    num_glanced_first: Annotated[int, Between(0, 100_000)] = 2
    """Before the next kind of features ranks them, so many are asked by retrieval alone, at most,
    until a pose is clear."""
    hopeless_gap: Annotated[float, Between(0, 2)] = 0.25
    """Tiles whose best place is so much less like the picture than the best tile's are not
    asked."""
    num_glanced: Annotated[int, Between(1, 100_000)] = 8
    """Where no tile leads, so many are asked by retrieval alone, at most, until a pose is clear;
    those asked before count."""
    num_asked: Annotated[int, Between(1, 10_000)] = 3
    """Tiles that are asked by all means, at most, until one answers."""
    least_likeness: Annotated[float, Between(-1, 2)] = 0.33
    """Any place looks so much like a picture. After the first one, tiles whose best place is less
    like it are asked by all means only where a glance names a pose."""
    alike_gap: Annotated[float, Between(0, 2)] = 0.1
    """Tiles whose best place is less like the picture than that of the tile that answered by no
    more than this must not vouch for a pose as well."""
    num_alike: Annotated[int, Between(0, 1000)] = 2
    """Of these, so many are asked."""
    max_ms: Annotated[float | None, AtLeast(0)] = None
    """After so many milliseconds no further tile is asked (None: no limit)."""
