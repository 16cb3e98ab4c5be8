"""Street trees: a stem, branches and some thousand single leaves; hedges and bushes of the same
leaves."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from topoloc_worlds.scene import Mesh, Surface
from topoloc_worlds.shapes import box, join, tube
from topoloc_worlds.street.materials import StreetMaterials


def tree(
    rng: np.random.Generator,
    kit: StreetMaterials,
    height: float = 7.5,
    crown: float = 2.3,
    num_leaves: int = 1400,
) -> list[Surface]:
    """A tree on the origin. The crown begins at about a third of the height and reaches `crown`
    metres to the side."""
    fork = height * float(rng.uniform(0.28, 0.36))
    lean = rng.normal(0.0, 0.03, 2)
    wood = [_stem(np.array([0.0, 0.0, -0.05]), np.array([*(lean * fork), fork]), 0.17, 0.12)]
    top = np.array([*(lean * height), height * 0.9])
    wood.append(_stem(np.array([*(lean * fork), fork]), top, 0.12, 0.03))
    tips = [top]
    for k in range(9):
        start = np.array([*(lean * fork), fork]) * (1 - k / 12) + top * (k / 12)
        angle, reach = (
            2.4 * k + float(rng.uniform(-0.4, 0.4)),
            crown * float(rng.uniform(0.55, 0.85)) * (1.0 - 0.045 * k),
        )
        end = start + reach * np.array([np.cos(angle), np.sin(angle), float(rng.uniform(0.5, 1.1))])
        wood.append(_stem(start, end, 0.06, 0.015))
        tips += [end, start * 0.4 + end * 0.6]
    return [
        Surface("tree stem", join(wood), kit.bark),
        Surface(
            "leaves", leaves(rng, _in_clusters(rng, np.array(tips), num_leaves, crown)), kit.leaves
        ),
    ]


def _stem(
    start: Float64[np.ndarray, "3"], end: Float64[np.ndarray, "3"], foot: float, top: float
) -> Mesh:
    """A branch that becomes thinner; its bark is repeated every 1.5 m."""
    rod = tube(start, end, 1.0, 7)
    half = len(rod.vertices) // 2
    axis = np.repeat(np.array([start, end]), half, axis=0)
    radius = np.repeat([foot, top], half)[:, None]
    length = float(np.linalg.norm(end - start))
    return Mesh(
        axis + (rod.vertices - axis) * radius, rod.faces, rod.uv * [1.0, max(length / 1.5, 0.2)]
    )


def _in_clusters(
    rng: np.random.Generator, tips: Float64[np.ndarray, "k 3"], num: int, crown: float
) -> Float64[np.ndarray, "n 3"]:
    """Leaves stand in clumps about the ends of branches, so that light and sky come through between
    them."""
    spread = crown * rng.uniform(0.2, 0.36, len(tips))
    chosen = rng.integers(0, len(tips), num)
    away = rng.standard_normal((num, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    return tips[chosen] + away * (spread[chosen] * rng.uniform(0.25, 1.0, num) ** 0.5)[:, None] * [
        1.25,
        1.25,
        0.95,
    ]


def leaves(
    rng: np.random.Generator,
    centres: Float64[np.ndarray, "n 3"],
    size: tuple[float, float] = (0.18, 0.36),
) -> Mesh:
    """One folded leaf of two triangles at each centre, turned at random, hanging a little, of one
    of 64 shades."""
    n = len(centres)
    along = rng.standard_normal((n, 3)) - [0.0, 0.0, 0.35]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(along, rng.standard_normal((n, 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    length = rng.uniform(*size, n)[:, None]
    fold = np.cross(along, across) * length * 0.12
    corners = [
        -0.5 * length * along,
        0.36 * length * across + fold,
        0.5 * length * along,
        -0.36 * length * across + fold,
    ]
    vertices = np.stack([centres + corner for corner in corners], axis=1).reshape(-1, 3)
    faces = (4 * np.arange(n)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    shade = (rng.integers(0, 8, (n, 2)) + 0.5) / 8.0
    return Mesh(vertices, faces.astype(np.int32), np.repeat(shade, 4, axis=0))


def hedge(
    rng: np.random.Generator, length: float, height: float, depth: float, kit: StreetMaterials
) -> list[Surface]:
    """A clipped hedge from the origin along x, with leaves that stick out of it."""
    low, high = np.zeros(3), np.array([length, depth, height])
    count = int(length * 24)
    points = rng.uniform(low, high, (count, 3))
    face = rng.integers(0, 3, count)
    points[face == 0, 1] = 0.0
    points[face == 1, 2] = height
    return [
        Surface("hedge", box(low, high, texels=0.7, faces="sewtn"), kit.hedge),
        Surface("leaves", leaves(rng, points, (0.07, 0.15)), kit.leaves),
    ]


def bush(rng: np.random.Generator, radius: float, kit: StreetMaterials) -> list[Surface]:
    """A bush on the origin."""
    away = rng.standard_normal((int(200 * radius), 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    points = away * radius * rng.uniform(0.5, 1.0, (len(away), 1))
    points[:, 2] = np.abs(points[:, 2]) * 1.2
    return [Surface("leaves", leaves(rng, points, (0.1, 0.22)), kit.leaves)]
