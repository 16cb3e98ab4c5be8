"""Store the light on the surfaces of a world in small cells of space. It is traced once and used by
every picture.

The light on a matt surface is the same from all viewpoints. So it is traced once for each cell
visible from possible camera positions (after Ward et al., *A ray tracing solution for diffuse
interreflection*, 1988), with enough paths, and pictures have no noise of their own. The cells
exclude direct sunlight, because its shadows are sharp.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from topoloc_worlds.rendering import light_cells_kernels as kernels

_GRID = 0.5
_MARGIN = 60.0
_ENOUGH_SHARP, _ENOUGH_SOFT = 10.0, 400.0
"""Points in a cell after which it takes little from its neighbours."""


@dataclass(frozen=True, eq=False)
class CellGrid:
    """How space is divided: cells of `finest` metres near `viewpoints`, growing with the distance
    so that they appear equally large.

    Attributes:
        frame: x and y of the corner of `distances`, height of the cameras, metres a pixel of
            `distances`.
        distances: from a place (row y, column x) to the nearest viewpoint, metres.
        finest: size of the smallest cells, metres.
        angle: size of a cell over its distance.
    """

    frame: Float64[np.ndarray, "4"]
    distances: Float32[np.ndarray, "rows columns"]
    finest: float
    angle: float


@dataclass(frozen=True, eq=False)
class LightCells:
    """Mean light in each cell that was seen: irradiance over pi, so that a matt surface sends back
    albedo times light."""

    grid: CellGrid
    keys: Int64[np.ndarray, " n"]
    light: Float32[np.ndarray, "n 3"]
    table: Int32[np.ndarray, " m"]


def divide_space(viewpoints: Float64[np.ndarray, "n 3"], finest: float, angle: float) -> CellGrid:
    """The cells of a world that is looked at from `viewpoints`."""
    low = viewpoints[:, :2].min(axis=0) - _MARGIN
    size = np.ceil((viewpoints[:, :2].max(axis=0) + _MARGIN - low) / _GRID).astype(int)
    far = np.full((size[1], size[0]), 255, np.uint8)
    columns, rows = ((viewpoints[:, :2] - low) / _GRID).astype(int).T
    far[rows, columns] = 0
    distances = (cv2.distanceTransform(far, cv2.DIST_L2, 5) * _GRID).astype(np.float32)
    return CellGrid(np.array([*low, viewpoints[:, 2].mean(), _GRID]), distances, finest, angle)


@dataclass(frozen=True, eq=False)
class FoundLight:
    """Irradiance over pi at each of n points. `sharp` is that of lamps, with shadows and little
    noise; `soft` that of the sky and of all surfaces, which is noisy and changes slowly from place
    to place."""

    sharp: Float32[np.ndarray, "n 3"]
    soft: Float32[np.ndarray, "n 3"]


class LightGatherer:
    """Collects samples of light, cell by cell."""

    def __init__(self, grid: CellGrid) -> None:
        self._grid = grid
        self._keys = np.empty(0, np.int64)
        self._sums = np.empty((0, 7))

    def add(
        self,
        points: Float64[np.ndarray, "n 3"],
        normals: Float32[np.ndarray, "n 3"],
        found: FoundLight,
    ) -> None:
        """Light found at points on surfaces."""
        g = self._grid
        keys = kernels.keys_of(points, normals, g.frame, g.distances, g.finest, g.angle)
        rows = np.column_stack([found.sharp, found.soft, np.ones(len(keys))])
        self._keys, where = np.unique(np.concatenate([self._keys, keys]), return_inverse=True)
        self._sums = _sum_rows(np.concatenate([self._sums, rows]), where.ravel(), len(self._keys))

    def cells(self) -> LightCells:
        """Return all collected light, smoothed in cells with few samples. Coarser cells are means
        of finer ones."""
        keys, table = self._keys, kernels.hash_table(self._keys)
        counts = self._sums[:, 6].astype(np.float32)
        sharp, soft = (
            (self._sums[:, k : k + 3] / self._sums[:, 6:]).astype(np.float32) for k in (0, 3)
        )
        sharp, _ = kernels.smooth(keys, sharp, counts, table, _ENOUGH_SHARP, 1)
        trusted = counts
        for step in (1, 2, 4):
            soft, trusted = kernels.smooth(keys, soft, trusted, table, _ENOUGH_SOFT, step)
        keys, light = _with_coarser(keys, sharp + soft, counts)
        return light_cells(self._grid, keys, light)


def light_cells(
    grid: CellGrid, keys: Int64[np.ndarray, " n"], light: Float32[np.ndarray, "n 3"]
) -> LightCells:
    """Cells ready to be looked up."""
    return LightCells(grid, keys, light, kernels.hash_table(keys))


def light_at(
    cells: LightCells, points: Float64[np.ndarray, "n 3"], normals: Float32[np.ndarray, "n 3"]
) -> Float32[np.ndarray, "n 3"]:
    """Light that falls on surfaces at `points` (world) with unit `normals` towards the side that is
    seen."""
    g = cells.grid
    ambient = cells.light.mean(axis=0) if len(cells.light) else np.zeros(3, np.float32)
    return kernels.look_up(
        points,
        normals,
        cells.keys,
        cells.light,
        cells.table,
        g.frame,
        g.distances,
        g.finest,
        g.angle,
        ambient,
    )


def _sum_rows(
    rows: Float64[np.ndarray, "n columns"], where: Int64[np.ndarray, " n"], count: int
) -> Float64[np.ndarray, "k columns"]:
    return np.column_stack([np.bincount(where, column, count) for column in rows.T])


def _with_coarser(
    keys: Int64[np.ndarray, " n"],
    light: Float32[np.ndarray, "n 3"],
    counts: Float32[np.ndarray, " n"],
) -> tuple[Int64[np.ndarray, " m"], Float32[np.ndarray, "m 3"]]:
    """Add a pyramid of coarser cells, which give the light of spots without a sample."""
    all_keys, all_light = [keys], [light]
    sums = np.column_stack([light * counts[:, None], counts]).astype(np.float64)
    for level in range(kernels.COARSEST + 2):
        at_level = keys >> 56 == level
        if not at_level.any():
            continue
        parents, where = np.unique(kernels.parents_of(keys[at_level]), return_inverse=True)
        parent_sums = _sum_rows(sums[at_level], where.ravel(), len(parents))
        new = ~np.isin(parents, keys)
        all_keys.append(parents[new])
        all_light.append((parent_sums[new, :3] / parent_sums[new, 3:]).astype(np.float32))
        keys, sums = np.concatenate([keys, parents[new]]), np.concatenate([sums, parent_sums[new]])
    return np.concatenate(all_keys), np.concatenate(all_light)
