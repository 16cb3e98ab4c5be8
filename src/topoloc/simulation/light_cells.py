"""The light that falls on the surfaces of a world, kept in small cells of space: found once, used by every picture.

What lamps, sky and walls send to a matt surface is the same from wherever it is seen. So it is traced once for each cell that
can be seen from where cameras will be (after Ward et al., *A ray tracing solution for diffuse interreflection*, 1988), with as
many paths as it takes, and pictures have no noise of their own. Direct sunlight, whose shadows are sharp, is not in the cells.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from topoloc.simulation import light_cells_kernels as kernels

_GRID = 0.5
_MARGIN = 60.0
_ENOUGH = 1500.0
"""Paths after which a cell needs nothing of its neighbours."""


@dataclass(frozen=True, eq=False)
class CellGrid:
    """How space is divided: cells of `finest` metres near `viewpoints`, growing with the distance so that they appear equally large.

    Attributes:
        frame: x and y of the corner of `distances`, height of the cameras, metres a pixel of `distances`.
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
    """Mean light in each cell that was seen: irradiance over pi, so that a matt surface sends back albedo times light."""

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


class LightGatherer:
    """Collects samples of light, cell by cell."""

    def __init__(self, grid: CellGrid) -> None:
        self._grid = grid
        self._keys = np.empty(0, np.int64)
        self._sums = np.empty((0, 4))

    def add(
        self, points: Float64[np.ndarray, "n 3"], normals: Float32[np.ndarray, "n 3"], light: Float32[np.ndarray, "n 3"], paths: int
    ) -> None:
        """Light found at points on surfaces, each the mean of `paths` paths."""
        g = self._grid
        keys = kernels.keys_of(points, normals, g.frame, g.distances, g.finest, g.angle)
        rows = np.column_stack([light * np.float32(paths), np.full(len(light), paths, np.float32)])
        self._keys, where = np.unique(np.concatenate([self._keys, keys]), return_inverse=True)
        self._sums = _sum_rows(np.concatenate([self._sums, rows]), where.ravel(), len(self._keys))

    def cells(self) -> LightCells:
        """All that was collected, smoothed where it was little; coarser cells are the means of the finer ones."""
        keys, sums = self._keys, self._sums
        table = kernels.hash_table(keys)
        counts = sums[:, 3].astype(np.float32)
        light = (sums[:, :3] / sums[:, 3:]).astype(np.float32)
        for _ in range(2):
            light, counts = kernels.smooth(keys, light, counts, table, np.float32(_ENOUGH))
        return light_cells(self._grid, *_with_coarser(keys, light, counts))


def light_cells(grid: CellGrid, keys: Int64[np.ndarray, " n"], light: Float32[np.ndarray, "n 3"]) -> LightCells:
    """Cells ready to be looked up."""
    return LightCells(grid, keys, light, kernels.hash_table(keys))


def light_at(cells: LightCells, points: Float64[np.ndarray, "n 3"], normals: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
    """Light that falls on surfaces at `points` (world) with unit `normals` towards the side that is seen."""
    g = cells.grid
    ambient = cells.light.mean(axis=0) if len(cells.light) else np.zeros(3, np.float32)
    return kernels.look_up(points, normals, cells.keys, cells.light, cells.table, g.frame, g.distances, g.finest, g.angle, ambient)


def _sum_rows(rows: Float64[np.ndarray, "n 4"], where: Int64[np.ndarray, " n"], count: int) -> Float64[np.ndarray, "k 4"]:
    return np.column_stack([np.bincount(where, rows[:, column], count) for column in range(4)])


def _with_coarser(
    keys: Int64[np.ndarray, " n"], light: Float32[np.ndarray, "n 3"], counts: Float32[np.ndarray, " n"]
) -> tuple[Int64[np.ndarray, " m"], Float32[np.ndarray, "m 3"]]:
    """With a pyramid above: whoever looks at a spot that no sample met finds the light around it."""
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
