"""The currency between the feature steps: key points with descriptors, and matches between two sets
of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32, Shaped

from topoloc.features.dense import DenseDescriptors

_ARRAY_FIELDS = ("points_img", "sizes_px", "angles", "responses", "descriptors")


@dataclass(frozen=True, eq=False)
class Features:
    """Local features of one image, strongest first.

    points_img are pixels (centre of the top-left pixel at (0, 0)); sizes_px the diameter of the
    neighbourhood described; angles in radians from +x towards +y (clockwise on the screen), 0 for
    upright ones; descriptors have unit length. Of a network also what it says of the whole picture,
    which a part of the features is without, and no node keeps: `cells` is what it saw in each cell,
    where the network has such, `dense` its descriptors each few pixels.
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
        """The features of these rows (indices or a boolean mask)."""
        return Features._from_arrays([getattr(self, name)[rows] for name in _ARRAY_FIELDS])

    @staticmethod
    def concatenate(parts: list[Features]) -> Features:
        return Features._from_arrays(
            [np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAY_FIELDS]
        )

    @staticmethod
    def _from_arrays(arrays: list[np.ndarray]) -> Features:
        points_img, sizes_px, angles, responses, descriptors = arrays
        return Features(points_img, sizes_px, angles, responses, descriptors)

    @staticmethod
    def empty(dimension: int) -> Features:
        zero = np.zeros(0, np.float32)
        return Features(
            np.zeros((0, 2), np.float32), zero, zero, zero, np.zeros((0, dimension), np.float32)
        )


@dataclass(frozen=True, eq=False)
class Matches:
    """Pairs of rows: `query_idx[k]` of the one set goes with `train_idx[k]` of the other, at this
    descriptor distance."""

    query_idx: Int32[np.ndarray, " m"]
    train_idx: Int32[np.ndarray, " m"]
    distances: Float32[np.ndarray, " m"]

    def __len__(self) -> int:
        return len(self.query_idx)
