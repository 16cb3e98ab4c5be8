"""Compiled loops of `light_cells`: from a point on a surface to its cell, and the light between
cells."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

COARSEST = 7
_BIAS = 1 << 16
_MASK = (1 << 17) - 1
_EMPTY = -1


@njit(cache=True, inline="always")
def _side(normal):
    """Which of 27 directions a normal points to."""
    code = 0
    for axis in range(3):
        code = 3 * code + (2 if normal[axis] > 0.5 else 0 if normal[axis] < -0.5 else 1)
    return code


@njit(cache=True, inline="always")
def _key(level, ix, iy, iz, side):
    return (
        ((level << 17 | ((ix + _BIAS) & _MASK)) << 17 | ((iy + _BIAS) & _MASK)) << 17
        | ((iz + _BIAS) & _MASK)
    ) << 5 | side


@njit(cache=True, inline="always")
def _level(point, frame, distances, finest, angle):
    """Return the level of the cells at a point. Cells grow with the distance to the viewpoints."""
    row = min(max(int((point[1] - frame[1]) / frame[3]), 0), distances.shape[0] - 1)
    column = min(max(int((point[0] - frame[0]) / frame[3]), 0), distances.shape[1] - 1)
    distance = np.hypot(distances[row, column], point[2] - frame[2])
    level = 0
    while level < COARSEST and distance * angle > 1.5 * finest * (1 << level):
        level += 1
    return level


@njit(cache=True, inline="always")
def _find(table, keys, key):
    slot = (key * np.int64(-7046029254386353131) >> 20) & (len(table) - 1)
    while table[slot] != _EMPTY:
        if keys[table[slot]] == key:
            return np.int64(table[slot])
        slot = (slot + 1) & (len(table) - 1)
    return np.int64(_EMPTY)


@njit(cache=True, parallel=True)
def keys_of(points, normals, frame, distances, finest, angle):
    """The cell of each point. Returns (n,) keys."""
    keys = np.empty(len(points), np.int64)
    for i in prange(len(points)):
        level = _level(points[i], frame, distances, finest, angle)
        size = finest * (1 << level)
        ix, iy, iz = (
            int(np.floor(points[i, 0] / size)),
            int(np.floor(points[i, 1] / size)),
            int(np.floor(points[i, 2] / size)),
        )
        keys[i] = _key(level, ix, iy, iz, _side(normals[i]))
    return keys


@njit(cache=True)
def hash_table(keys):
    """Open addressing: each slot holds a row of `keys` or nothing."""
    size = 1024
    while size < 2 * len(keys):
        size *= 2
    table = np.full(size, _EMPTY, np.int32)
    for row in range(len(keys)):
        slot = (keys[row] * np.int64(-7046029254386353131) >> 20) & (size - 1)
        while table[slot] != _EMPTY:
            slot = (slot + 1) & (size - 1)
        table[slot] = row
    return table


@njit(cache=True, parallel=True)
def look_up(points, normals, keys, light, table, frame, distances, finest, angle, ambient):
    """Interpolate light at points on surfaces between the centres of the neighbouring cells, or of
    coarser cells if these are empty. (n, 3)."""
    found = np.empty((len(points), 3), np.float32)
    for i in prange(len(points)):
        side = _side(normals[i])
        level = _level(points[i], frame, distances, finest, angle)
        total, r, g, b = 0.0, 0.0, 0.0, 0.0
        while level <= COARSEST + 2 and total < 1e-3:
            size = finest * (1 << level)
            x, y, z = (
                points[i, 0] / size - 0.5,
                points[i, 1] / size - 0.5,
                points[i, 2] / size - 0.5,
            )
            ix, iy, iz = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
            total, r, g, b = 0.0, 0.0, 0.0, 0.0
            for corner in range(8):
                jx, jy, jz = corner & 1, corner >> 1 & 1, corner >> 2
                weight = abs(1 - jx - (x - ix)) * abs(1 - jy - (y - iy)) * abs(1 - jz - (z - iz))
                row = _find(table, keys, _key(level, ix + jx, iy + jy, iz + jz, side))
                if row != _EMPTY:
                    total += weight
                    r += weight * light[row, 0]
                    g += weight * light[row, 1]
                    b += weight * light[row, 2]
            level += 1
        if total < 1e-3:
            found[i] = ambient
        else:
            found[i, 0], found[i, 1], found[i, 2] = r / total, g / total, b / total
    return found


@njit(cache=True, parallel=True)
def smooth(keys, light, counts, table, enough, step):
    """Cells with few samples take from those `step` cells away, of the same side and size. Returns
    light (n, 3) and counts (n,)."""
    result = np.empty_like(light)
    trusted = np.empty_like(counts)
    for row in prange(len(keys)):
        key = keys[row]
        side, level = key & 31, key >> 56
        iz, iy, ix = (
            (key >> 5 & _MASK) - _BIAS,
            (key >> 22 & _MASK) - _BIAS,
            (key >> 39 & _MASK) - _BIAS,
        )
        share = enough / (enough + counts[row])
        total = counts[row]
        r, g, b = light[row, 0] * total, light[row, 1] * total, light[row, 2] * total
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                for dz in range(-1, 2):
                    steps = abs(dx) + abs(dy) + abs(dz)
                    if steps == 0:
                        continue
                    other = _find(
                        table,
                        keys,
                        _key(level, ix + step * dx, iy + step * dy, iz + step * dz, side),
                    )
                    if other == _EMPTY:
                        continue
                    weight = counts[other] * share * 0.5 ** (steps - 1)
                    total += weight
                    r += weight * light[other, 0]
                    g += weight * light[other, 1]
                    b += weight * light[other, 2]
        result[row, 0], result[row, 1], result[row, 2] = r / total, g / total, b / total
        trusted[row] = total
    return result, trusted


@njit(cache=True)
def parents_of(keys):
    """The cell of twice the size around each."""
    parents = np.empty_like(keys)
    for row in range(len(keys)):
        key = keys[row]
        side, level = key & 31, key >> 56
        iz, iy, ix = (
            (key >> 5 & _MASK) - _BIAS,
            (key >> 22 & _MASK) - _BIAS,
            (key >> 39 & _MASK) - _BIAS,
        )
        parents[row] = _key(level + 1, ix >> 1, iy >> 1, iz >> 1, side)
    return parents
