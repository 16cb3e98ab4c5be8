"""Pieces of a house front: a wall with a grid of openings, reveals, frames, panes, sills,
balconies, roofs.

In a front's own frame x runs to the right and z up, seen from the street, and y into the house; the
wall is at y = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float64

from topoloc_worlds.scene import Mesh, Surface
from topoloc_worlds.shapes import box, join, panel, placed
from topoloc_worlds.street.textures import WALL_METRES

Span = tuple[float, float]
Openings = Float64[np.ndarray, "n 4"]
"""x from, x to, z from, z to of each."""


def quads(corners: Float64[np.ndarray, "n 4 3"], uv: Float64[np.ndarray, "n 4 2"]) -> Mesh:
    """Quadrangles, each with its own corners: top left, bottom left, bottom right, top right."""
    start = 4 * np.arange(len(corners))[:, None, None]
    faces = (start + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    return Mesh(corners.reshape(-1, 3), faces.astype(np.int32), uv.reshape(-1, 2))


def upright(spans: Openings, y: float) -> Float64[np.ndarray, "n 4 3"]:
    """Corners of rectangles that face the street at depth `y`."""
    x0, x1, z0, z1 = spans.T
    depth = np.full(len(spans), y)
    rows = [(x0, depth, z1), (x0, depth, z0), (x1, depth, z0), (x1, depth, z1)]
    return np.stack([np.column_stack(row) for row in rows], axis=1)


def wall_uv(corners: Float64[np.ndarray, "n 4 3"], shift: float) -> Float64[np.ndarray, "n 4 2"]:
    """Map a picture of a wall of WALL_METRES to a front: its foot at z = 0, moved sideways by
    `shift` metres."""
    height, width = WALL_METRES
    return np.stack(
        [
            (corners[..., 0] + shift + 0.37 * corners[..., 1]) / width,
            1.0 - corners[..., 2] / height,
        ],
        axis=-1,
    )


def wall(
    width: float,
    z: Span,
    columns: Sequence[Span],
    rows: Sequence[Span],
    blind: Bool[np.ndarray, "r c"],
    shift: float,
) -> tuple[Mesh, Openings]:
    """Build a wall from z[0] to z[1] with an opening at each crossing of a column and a row, except
    blind ones. Return the openings, too."""
    xs = np.unique([0.0, width, *(x for column in columns for x in column)])
    zs = np.unique([*z, *(height for row in rows for height in row)])
    holes = np.array(
        [
            [c[0], c[1], r[0], r[1]]
            for i, r in enumerate(rows)
            for j, c in enumerate(columns)
            if not blind[i, j]
        ]
    ).reshape(-1, 4)
    pieces = []
    for x0, x1 in pairwise(xs.tolist()):
        free = [z[0]]
        inside = holes[(holes[:, 0] <= x0 + 1e-9) & (holes[:, 1] >= x1 - 1e-9)]
        for low, high in inside[np.argsort(inside[:, 2]), 2:]:
            pieces.append((x0, x1, free[-1], low))
            free.append(high)
        pieces.append((x0, x1, free[-1], zs[-1]))
    corners = upright(np.array([p for p in pieces if p[3] - p[2] > 1e-6]), 0.0)
    return quads(corners, wall_uv(corners, shift)), holes


def reveals(openings: Openings, depth: float, shift: float) -> Mesh:
    """The four inner sides of each opening."""
    x0, x1, z0, z1 = openings.T
    near, far = np.zeros(len(openings)), np.full(len(openings), depth)
    sides = [
        [(x0, near, z1), (x0, near, z0), (x0, far, z0), (x0, far, z1)],
        [(x1, far, z1), (x1, far, z0), (x1, near, z0), (x1, near, z1)],
        [(x0, near, z1), (x0, far, z1), (x1, far, z1), (x1, near, z1)],
        [(x0, far, z0), (x0, near, z0), (x1, near, z0), (x1, far, z0)],
    ]
    corners = np.concatenate(
        [np.stack([np.column_stack(row) for row in side], axis=1) for side in sides]
    )
    return quads(corners, wall_uv(corners, shift))


def panes(openings: Openings, depth: float, parts: Float64[np.ndarray, "n 2 2"]) -> Mesh:
    """A pane in each opening that shows a part of a picture: its corner (u, v) and its size."""
    uv = (
        parts[:, None, 0]
        + np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1.0, 0.0]])[None] * parts[:, None, 1]
    )
    return quads(upright(openings, depth), uv)


def frames(
    openings: Openings, depth: float, bars: tuple[int, int], thickness: float = 0.06
) -> Mesh:
    """Window frames just before the panes: a border, and `bars` bars standing and lying."""
    t, pieces = thickness, []
    for x0, x1, z0, z1 in openings.tolist():
        pieces += [
            (x0, x0 + t, z0, z1),
            (x1 - t, x1, z0, z1),
            (x0 + t, x1 - t, z0, z0 + t),
            (x0 + t, x1 - t, z1 - t, z1),
        ]
        for k in range(bars[0]):
            x = x0 + (x1 - x0) * (k + 1) / (bars[0] + 1)
            pieces.append((x - t * 0.6, x + t * 0.6, z0 + t, z1 - t))
        for k in range(bars[1]):
            z = z0 + (z1 - z0) * (0.68 if bars[1] == 1 else (k + 1) / (bars[1] + 1))
            pieces.append((x0 + t, x1 - t, z - t * 0.5, z + t * 0.5))
    corners = upright(np.array(pieces), depth - 0.05)
    return quads(corners, np.zeros((len(corners), 4, 2)))


def bands(spans: Openings, out: float, back: float = 0.0) -> Mesh:
    """Boxes lying on the wall, `out` before it: sills, lintels, cornices, surrounds, boards."""
    return join(
        [box((x0, -out, z0), (x1, back, z1), faces="sewtb") for x0, x1, z0, z1 in spans.tolist()]
    )


def surrounds(openings: Openings, thickness: float) -> Float64[np.ndarray, "m 4"]:
    """The frames of stone or plaster about openings, as spans for bands()."""
    x0, x1, z0, z1 = openings.T
    t = thickness
    return np.concatenate(
        [
            np.column_stack([x0 - t, x0, z0, z1]),
            np.column_stack([x1, x1 + t, z0, z1]),
            np.column_stack([x0 - t, x1 + t, z1, z1 + t]),
        ]
    )


def sills(openings: Openings, out: float = 0.12) -> Mesh:
    """A ledge below each opening."""
    x0, x1, z0, _ = openings.T
    return bands(np.column_stack([x0 - 0.08, x1 + 0.08, z0 - 0.09, z0]), out, 0.1)


def balcony(span: Span, z: float, out: float) -> tuple[Mesh, Mesh]:
    """A slab before the wall with its railing: slab, bars."""
    x0, x1 = span
    slab = box((x0, -out, z - 0.16), (x1, 0.0, z))
    top = z + 1.0
    bars = [
        box((x0, -out, top - 0.04), (x1, -out + 0.05, top)),
        box((x0, -out, z + 0.1), (x1, -out + 0.03, z + 0.14)),
    ]
    for x in (x0, x1 - 0.05):
        bars.append(box((x, -out, top - 0.04), (x + 0.05, 0.0, top)))
        bars.append(box((x, -out, z), (x + 0.05, -out + 0.05, top)))
    stands = np.arange(x0 + 0.14, x1 - 0.06, 0.14)
    rows = upright(
        np.column_stack(
            [stands, stands + 0.025, np.full(len(stands), z), np.full(len(stands), top)]
        ),
        -out + 0.02,
    )
    return slab, join([*bars, quads(rows, np.zeros((len(rows), 4, 2)))])


def gable_roof(
    width: float, depth: float, eaves: float, rise: float, overhang: float = 0.45
) -> tuple[Mesh, Mesh]:
    """Two slopes with the ridge along the street, and the two triangles of wall below them. Tiles
    are 2.56 m a picture."""
    slope = np.hypot(depth / 2 + overhang, rise * (1 + 2 * overhang / depth))
    low, top = eaves - rise * 2 * overhang / depth, eaves + rise
    repeat = (width / 2.56, slope / 2.56)
    run = depth / 2 + overhang
    front = panel((0.0, depth / 2, top), (width, 0, 0), (0, -run, low - top), repeat)
    back = panel((width, depth / 2, top), (-width, 0, 0), (0, run, low - top), repeat)
    ends = []
    for x in (0.02, width - 0.02):
        corners = np.array([[x, 0.0, eaves], [x, depth, eaves], [x, depth / 2, top]])
        uv = np.column_stack([corners[:, 1] / WALL_METRES[1], 1 - corners[:, 2] / WALL_METRES[0]])
        ends.append(Mesh(corners, np.array([[0, 1, 2]], np.int32), uv))
    soffit = panel((0.0, -overhang, low - 0.01), (width, 0, 0), (0, overhang, 0))
    return join([front, back]), join([*ends, soffit])


def side_walls(width: float, depth: float, height: float, which: str) -> list[Mesh]:
    """The house's walls across the street and its back: "l", "r", "b"."""
    uv_width, uv_height = depth / WALL_METRES[1], height / WALL_METRES[0]
    made = {
        "l": panel((0.0, depth, height), (0, -depth, 0), (0, 0, -height), (uv_width, uv_height)),
        "r": panel((width, 0.0, height), (0, depth, 0), (0, 0, -height), (uv_width, uv_height)),
        "b": panel(
            (width, depth, height),
            (-width, 0, 0),
            (0, 0, -height),
            (width / WALL_METRES[1], uv_height),
        ),
    }
    result = []
    for side in which:
        mesh = made[side]
        # The wall's foot, where its picture is damp, belongs on the ground.
        result.append(Mesh(mesh.vertices, mesh.faces, mesh.uv + np.array([0.0, 1.0 - uv_height])))
    return result


def set_at(surfaces: list[Surface], at: tuple[float, float, float], yaw: float) -> list[Surface]:
    """The same things elsewhere."""
    return [Surface(s.name, placed(s.mesh, at, yaw), s.material) for s in surfaces]
