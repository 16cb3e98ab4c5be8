"""Define the data exchanged between the feature steps: key points with descriptors, and matches
between two sets of them. Define the settings of matching.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, Shaped

from topoloc.bounds import Between

_ARRAY_FIELDS = ("points_img", "sizes_px", "angles", "responses", "descriptors")


@runtime_checkable
class DenseDescriptors(Protocol):
    """The interface of dense descriptors of an image (`dense.py` implements it)."""

    stride_px: float

    @property
    def size(self) -> int:
        """Return the length of a descriptor."""
        ...

    def sample(self, points_img: Float32[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n d"]:
        """Return descriptors of unit length at these pixels, interpolated bilinearly."""
        ...

    def check_agreement(
        self, points_img: Float[np.ndarray, "n 2"], descriptors: Float32[np.ndarray, "n d"]
    ) -> Bool[np.ndarray, " n"]:
        """Return for each point whether its best match lies at its projection."""
        ...


@dataclass(frozen=True, eq=False)
class Features:
    """Hold the local features of one image, strongest first.

    points_img are pixels (centre of the top-left pixel at (0, 0)). sizes_px are diameters of the
    described neighbourhoods. angles are radians from +x towards +y (clockwise on the screen), 0 for
    upright features. descriptors have unit length.

    Features of a network may include outputs for the whole image. `cells` holds the mean network
    output of each image cell. `dense` holds the dense descriptors. `select` and `concatenate` drop
    both, and nodes do not store them.
    """

    points_img: Float32[np.ndarray, "n 2"]
    sizes_px: Float32[np.ndarray, " n"]
    angles: Float32[np.ndarray, " n"]
    responses: Float32[np.ndarray, " n"]
    descriptors: Float32[np.ndarray, "n d"]
    cells: Float32[np.ndarray, "rows columns c"] | None = None
    dense: DenseDescriptors | None = None

    def __len__(self) -> int:
        return len(self.points_img)

    def select(self, rows: Shaped[np.ndarray, " m"]) -> Features:
        """Return the features of these rows (indices or a boolean mask)."""
        return Features._from_arrays([getattr(self, name)[rows] for name in _ARRAY_FIELDS])

    @staticmethod
    def concatenate(parts: list[Features]) -> Features:
        """Return the features of all parts, in their order. There must be at least one part."""
        return Features._from_arrays(
            [np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAY_FIELDS]
        )

    @staticmethod
    def _from_arrays(arrays: list[np.ndarray]) -> Features:
        points_img, sizes_px, angles, responses, descriptors = arrays
        return Features(points_img, sizes_px, angles, responses, descriptors)

    @staticmethod
    def empty(dimension: int) -> Features:
        """Return no features, with descriptors of this length."""
        zero = np.zeros(0, np.float32)
        points_img, descriptors = (np.zeros((0, size), np.float32) for size in (2, dimension))
        return Features(points_img, zero, zero, zero, descriptors)


@dataclass(frozen=True, eq=False)
class Matches:
    """Hold matched pairs of rows: `query_idx[k]` of one set matches `train_idx[k]` of the other, at
    this descriptor distance."""

    query_idx: Int32[np.ndarray, " m"]
    train_idx: Int32[np.ndarray, " m"]
    distances: Float32[np.ndarray, " m"]

    def __len__(self) -> int:
        return len(self.query_idx)


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
