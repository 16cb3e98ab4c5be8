"""A network's descriptors of a whole picture, and how far they agree with map points where these must be seen.

A key point must be found anew to speak for a pose, and in rain or by night most are not. What a network says of every few pixels needs no
finding: where a pose is right, the descriptor most like the map point's, of all around, lies where the point must be seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32

from topoloc.features.learned_kernels import is_most_similar_here, turned_to_unit_length

_RADIUS = 4  # grid steps to each side among which the most similar descriptor is sought


@dataclass(frozen=True, eq=False)
class DenseDescriptors:
    """As a network gives them: `planes`, not of unit length, one descriptor each `stride_px` pixels; that of pixel (x, y) lies at column
    (x + 0.5) / stride_px - 0.5."""

    planes: Float32[np.ndarray, "d rows columns"]
    stride_px: float

    @cached_property
    def _grid(self) -> Float32[np.ndarray, "rows columns d"]:
        return turned_to_unit_length(self.planes)

    def agrees(self, points_img: Float[np.ndarray, "n 2"], descriptors: Float32[np.ndarray, "n d"]) -> Bool[np.ndarray, " n"]:
        """Is the descriptor most like each of these, of all within 4 grid steps to each side of its point, at most one step off?"""
        return is_most_similar_here(self._grid, points_img.astype(np.float32), descriptors, np.float32(self.stride_px), _RADIUS)
