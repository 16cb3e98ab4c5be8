"""A network's descriptors of a whole picture, and how far they agree with map points where these
must be seen.

A key point must be found anew to speak for a pose, and in rain or by night most are not. What a
network says of every few pixels needs no finding: where a pose is right, the descriptor most like
the map point's, of all around, lies where the point must be seen.
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

_RADIUS = 4  # grid steps to each side among which the most similar descriptor is sought


class DenseDescriptors(ABC):
    """One descriptor each `stride_px` pixels; that of pixel (x, y) lies at column (x + 0.5) /
    stride_px - 0.5."""

    stride_px: float

    @property
    @abstractmethod
    def size(self) -> int:
        """Numbers a descriptor."""

    @abstractmethod
    def sample(self, points_img: Float32[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n d"]:
        """Descriptors of unit length between those of the grid, bilinear."""

    @abstractmethod
    def _normalized_grid(self) -> Float32[np.ndarray, "rows columns d"]:
        """All of the grid, of unit length."""

    @cached_property
    def _grid(self) -> Float32[np.ndarray, "rows columns d"]:
        return self._normalized_grid()

    def check_agreement(
        self, points_img: Float[np.ndarray, "n 2"], descriptors: Float32[np.ndarray, "n d"]
    ) -> Bool[np.ndarray, " n"]:
        """Is the descriptor most like each of these, of all within 4 grid steps to each side of its
        point, at most one step off?"""
        return is_local_best_match(
            self._grid,
            points_img.astype(np.float32),
            descriptors,
            np.float32(self.stride_px),
            _RADIUS,
        )


@dataclass(frozen=True, eq=False)
class SingleLevelDescriptors(DenseDescriptors):
    """As most networks give them: one plane a number, not of unit length."""

    planes: Float32[np.ndarray, "d rows columns"]
    stride_px: float

    @property
    def size(self) -> int:
        return self.planes.shape[0]

    def sample(self, points_img: Float32[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n d"]:
        return sample_descriptors(self.planes, points_img, np.float32(self.stride_px))

    def _normalized_grid(self) -> Float32[np.ndarray, "rows columns d"]:
        return normalize_descriptors(self.planes)


@dataclass(frozen=True, eq=False)
class TwoLevelDescriptors(DenseDescriptors):
    """As a network gives them that only ever adds two levels up: `coarse`, enlarged to twice its
    rows and columns (bilinear), and `fine` times `weights`. Both are linear, and far fewer
    descriptors are asked for than there are: so they are added up where they are."""

    coarse: Float32[np.ndarray, "half_rows half_columns d"]
    fine: Float32[np.ndarray, "rows columns k"]
    weights: Float32[np.ndarray, "k d"]
    stride_px: float

    @property
    def size(self) -> int:
        return self.coarse.shape[2]

    def sample(self, points_img: Float32[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n d"]:
        return sample_levels(
            self.coarse, self.fine, self.weights, points_img, np.float32(self.stride_px)
        )

    def _normalized_grid(self) -> Float32[np.ndarray, "rows columns d"]:
        return combine_levels(self.coarse, self.fine, self.weights)
