"""Meshes to build places from: panels, boxes, prisms, tubes, turned shapes; moved, turned and
joined."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from topoloc_worlds.scene import Mesh, Surface

Number = float | int
Vector = Sequence[Number] | Float64[np.ndarray, "3"]


def panel(
    corner: Vector, across: Vector, down: Vector, repeat: tuple[Number, Number] = (1.0, 1.0)
) -> Mesh:
    """Build a parallelogram with `across` to the right and `down` downwards for its viewer.
    `corner` is its top left.

    Args:
        repeat: repeats of the picture across and down.
    """
    origin, x, y = (np.asarray(v, dtype=np.float64) for v in (corner, across, down))
    vertices = np.stack([origin, origin + y, origin + x + y, origin + x])
    uv = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1.0, 0.0]]) * np.asarray(repeat)
    return Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]], np.int32), uv)


def box(low: Vector, high: Vector, texels: Number | None = None, faces: str = "nsewtb") -> Mesh:
    """An axis-aligned box. Each face carries the whole picture, upright on the four sides.

    Args:
        texels: repeats of the picture per metre instead, the same on all faces.
        faces: which of north (+y), south (-y), east (+x), west (-x), top and bottom there are.
    """
    x0, y0, z0 = (float(v) for v in low)
    x1, y1, z1 = (float(v) for v in high)
    w, d, h = x1 - x0, y1 - y0, z1 - z0
    sides = {
        "n": ((x1, y1, z1), (-w, 0, 0), (0, 0, -h)),
        "s": ((x0, y0, z1), (w, 0, 0), (0, 0, -h)),
        "e": ((x1, y0, z1), (0, d, 0), (0, 0, -h)),
        "w": ((x0, y1, z1), (0, -d, 0), (0, 0, -h)),
        "t": ((x0, y1, z1), (w, 0, 0), (0, -d, 0)),
        "b": ((x0, y0, z0), (w, 0, 0), (0, d, 0)),
    }
    origin, across, down = np.array([sides[face] for face in faces], dtype=np.float64).transpose(
        1, 0, 2
    )
    vertices = np.stack(
        [origin, origin + down, origin + across + down, origin + across], axis=1
    ).reshape(-1, 3)
    repeat = np.ones((len(faces), 2))
    if texels is not None:
        repeat = texels * np.column_stack(
            [np.linalg.norm(across, axis=1), np.linalg.norm(down, axis=1)]
        )
    uv = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1.0, 0.0]])[None] * repeat[:, None]
    triangles = 4 * np.arange(len(faces))[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
    return Mesh(vertices, triangles.reshape(-1, 3).astype(np.int32), uv.reshape(-1, 2))


def prism(
    outline: Sequence[Sequence[Number]] | Float64[np.ndarray, "n 2"],
    low: Number,
    high: Number,
    texels: Number | None = None,
) -> Mesh:
    """A convex outline (x, y), counter-clockwise from above, raised from z `low` to `high`; the
    picture goes round the sides."""
    corners = np.asarray(outline, dtype=np.float64)
    around = np.concatenate(
        [[0.0], np.cumsum(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1))]
    )
    scale_u, scale_v = (
        (1.0 / around[-1], 1.0) if texels is None else (texels, texels * (high - low))
    )
    walls = []
    for i in range(len(corners)):
        a, b = corners[i], corners[(i + 1) % len(corners)]
        wall = panel((*a, high), (*(b - a), 0.0), (0.0, 0.0, low - high))
        u0, u1 = around[i] * scale_u, around[i + 1] * scale_u
        walls.append(
            Mesh(
                wall.vertices,
                wall.faces,
                np.array([[u0, 0.0], [u0, scale_v], [u1, scale_v], [u1, 0.0]]),
            )
        )
    fan = np.array([[0, i, i + 1] for i in range(1, len(corners) - 1)], np.int32)
    size = np.maximum(np.ptp(corners, axis=0), 1e-9)
    uv = (corners - corners.min(axis=0)) / size if texels is None else corners * texels
    top = Mesh(np.column_stack([corners, np.full(len(corners), high)]), fan, uv)
    bottom = Mesh(np.column_stack([corners, np.full(len(corners), low)]), fan[:, ::-1].copy(), uv)
    return join([*walls, top, bottom])


def cylinder(
    centre: Sequence[Number], radius: Number, low: Number, high: Number, num_sides: int = 16
) -> Mesh:
    """An upright cylinder of `num_sides` flat sides around (x, y)."""
    angles = np.arange(num_sides) * (2 * np.pi / num_sides)
    return prism(
        np.asarray(centre) + radius * np.column_stack([np.cos(angles), np.sin(angles)]), low, high
    )


def tube(start: Vector, end: Vector, radius: Number, num_sides: int = 8) -> Mesh:
    """A rod from one point to another, without caps; the picture goes round it."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    along = (b - a) / np.linalg.norm(b - a)
    side = np.cross(along, [0.0, 0.0, 1.0] if abs(along[2]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    angles = np.arange(num_sides + 1) * (2 * np.pi / num_sides)
    ring = radius * (
        np.outer(np.cos(angles), side) + np.outer(np.sin(angles), np.cross(along, side))
    )
    n = num_sides + 1
    i = np.arange(num_sides)
    faces = np.concatenate(
        [np.column_stack([i, i + 1, n + i + 1]), np.column_stack([i, n + i + 1, n + i])]
    )
    u = np.linspace(0.0, 1.0, n)
    uv = np.concatenate([np.column_stack([u, np.ones(n)]), np.column_stack([u, np.zeros(n)])])
    return Mesh(np.concatenate([a + ring, b + ring]), faces.astype(np.int32), uv)


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate(
            [mesh.faces + np.int32(start) for mesh, start in zip(meshes, starts, strict=False)]
        ).astype(np.int32),
        np.concatenate([mesh.uv for mesh in meshes]),
    )


def placed(mesh: Mesh, at: Vector, yaw: Number = 0.0) -> Mesh:
    """The mesh turned about the z axis by `yaw` (radians, counter-clockwise from above), then moved
    by `at`."""
    c, s = np.cos(yaw), np.sin(yaw)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return Mesh(mesh.vertices @ rotation.T + np.asarray(at, dtype=np.float64), mesh.faces, mesh.uv)


def lathe(profile: Sequence[tuple[Number, Number]], num_sides: int = 16) -> Mesh:
    """A profile of (radius, z), from below to above on the outside, turned about the z axis; the
    picture goes round it once."""
    rings = np.asarray(profile, dtype=np.float64)
    angles = np.linspace(0.0, 2 * np.pi, num_sides + 1)
    circle = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(num_sides + 1)])
    vertices = np.concatenate([radius * circle + [0.0, 0.0, z] for radius, z in rings])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(rings, axis=0), axis=1))])
    u = np.linspace(0.0, 1.0, num_sides + 1)
    uv = np.concatenate(
        [np.column_stack([u, np.full(num_sides + 1, 1.0 - a / along[-1])]) for a in along]
    )
    i = np.arange(num_sides)
    faces = []
    for ring in range(len(rings) - 1):
        a, b = ring * (num_sides + 1), (ring + 1) * (num_sides + 1)
        faces += [
            np.column_stack([a + i, a + i + 1, b + i + 1]),
            np.column_stack([a + i, b + i + 1, b + i]),
        ]
    return Mesh(vertices, np.concatenate(faces).astype(np.int32), uv)


def bent_tube(points: Sequence[Vector], radius: Number, num_sides: int = 6) -> Mesh:
    """A cable or pipe through the points."""
    return join([tube(a, b, radius, num_sides) for a, b in itertools.pairwise(points)])


def turned(mesh: Mesh, axis: Vector, angle: Number) -> Mesh:
    """The mesh turned about an axis through the origin (right-handed, radians)."""
    x, y, z = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return Mesh(mesh.vertices @ rotation.T, mesh.faces, mesh.uv)


def surfaces_placed(surfaces: Sequence[Surface], at: Vector, yaw: Number = 0.0) -> list[Surface]:
    """Place an object of several surfaces, as `placed` does for one."""
    return [replace(surface, mesh=placed(surface.mesh, at, yaw)) for surface in surfaces]
