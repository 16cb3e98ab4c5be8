"""Hold a network's dense descriptors of a whole image and compare them with map points at their
projections.

A key point supports a pose only if it is detected again. In rain or at night most key points are
not. Dense descriptors need no detection. If a pose is right, the most similar descriptor around a
map point's projection lies at the projection itself.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32

from topoloc.features.learned_kernels import (
    combine_levels,
    is_local_best_match,
    normalize_descriptors,
    sample_descriptors,
    sample_levels,
)

_RADIUS = 4  # grid steps to each side in which the most similar descriptor is searched


class GridDescriptors(ABC):
    """Hold one descriptor every `stride_px` pixels. The descriptor of pixel (x, y) lies at column
    (x + 0.5) / stride_px - 0.5, and rows likewise."""

    stride_px: float

    @property
    @abstractmethod
    def size(self) -> int:
        """Return the length of a descriptor."""

    @abstractmethod
    def sample(self, points_img: Float32[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n d"]:
        """Return descriptors of unit length at these pixels, interpolated bilinearly."""

    @abstractmethod
    def _normalized_grid(self) -> Float32[np.ndarray, "rows columns d"]:
        """Return the whole grid with descriptors of unit length."""

    @cached_property
    def _grid(self) -> Float32[np.ndarray, "rows columns d"]:
        return self._normalized_grid()

    def check_agreement(
        self, points_img: Float[np.ndarray, "n 2"], descriptors: Float32[np.ndarray, "n d"]
    ) -> Bool[np.ndarray, " n"]:
        """Return for each point whether its best match lies at its projection.

        The most similar descriptor is searched within 4 grid steps to each side. It must lie at
        most one grid step from the point.
        """
        return is_local_best_match(
            self._grid,
            points_img.astype(np.float32),
            descriptors,
            np.float32(self.stride_px),
            _RADIUS,
        )


@dataclass(frozen=True, eq=False)
class SingleLevelDescriptors(GridDescriptors):
    """Hold the output of most networks: one plane per component, not of unit length."""

    planes: Float32[np.ndarray, "d rows columns"]
    stride_px: float

    @property
    def size(self) -> int:
        """Return the length of a descriptor."""
        return self.planes.shape[0]

    def sample(self, points_img: Float32[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n d"]:
        """Return descriptors of unit length at these pixels, interpolated bilinearly."""
        return sample_descriptors(self.planes, points_img, np.float32(self.stride_px))

    def _normalized_grid(self) -> Float32[np.ndarray, "rows columns d"]:
        return normalize_descriptors(self.planes)


@dataclass(frozen=True, eq=False)
class TwoLevelDescriptors(GridDescriptors):
    """Hold two levels whose sum is the descriptors: `coarse`, enlarged bilinearly to twice its rows
    and columns, and `fine` times `weights`.

    Both operations are linear, and few descriptors of the grid are sampled. So the sum is computed
    only at the sampled points.
    """

    coarse: Float32[np.ndarray, "half_rows half_columns d"]
    fine: Float32[np.ndarray, "rows columns k"]
    weights: Float32[np.ndarray, "k d"]
    stride_px: float

    @property
    def size(self) -> int:
        """Return the length of a descriptor."""
        return self.coarse.shape[2]

    def sample(self, points_img: Float32[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n d"]:
        """Return descriptors of unit length at these pixels, interpolated bilinearly."""
        return sample_levels(
            self.coarse, self.fine, self.weights, points_img, np.float32(self.stride_px)
        )

    def _normalized_grid(self) -> Float32[np.ndarray, "rows columns d"]:
        return combine_levels(self.coarse, self.fine, self.weights)
