"""Find the floor in the points of a map, which gives gravity and the height of the cameras.

A floor is the lowest large plane below the cameras. Tables are smaller or higher, and what lies
below the floor (mirror images, wrong matches) is no plane.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from topoloc import MapError, TopoMetricMap

_CELL = 0.25  # metres; a plane counts cells, so a textured table weighs no more than its area
_CAMERA_SIGMA = math.radians(10.0)  # of the mean up direction of a camera in the hand
_TOLERANCE = 0.03  # metres
_NO_FLOOR = (
    "no floor is seen below the cameras; if an axis of the map points up, name it with --up and"
    " give --camera-height, else give three points with heights: --points FILE"
)


@dataclass(frozen=True, eq=False)
class Floor:
    """The plane ``up_world @ x = offset`` (metres), the area that its points cover (m^2), and the
    sigma of its normal (radians, 0 if it is given)."""

    up_world: Float[np.ndarray, "3"]
    offset: float
    area_m2: float
    sigma_tilt: float


def find_floor(topomap: TopoMetricMap, up_world: Float[np.ndarray, "3"] | None = None) -> Floor:
    """Find the floor of the map.

    Args:
        up_world: the exact up direction, a unit vector, so that only the height is searched.

    Raises:
        MapError: no floor is seen, or too little to level the map by it.
    """
    max_tilt_sigma, min_cells = math.radians(1.5), 12
    # Points of stereo err together. Seven drafts (streets and corridors of seeds 1 to 3, hospital
    # 1) are tilted by 0.03 to 0.23 degrees, where the scatter of their points says 0.01 to 0.06.
    shared_sigma = math.radians(0.2)
    mean = -np.mean([one.world_from_cam.rotation[:, 1] for one in topomap.summaries], axis=0)
    up = mean / np.linalg.norm(mean) if up_world is None else up_world
    points = _points_below(topomap, up)
    starts = [up] if up_world is not None else [up, _sample_normal(points, up)]
    found = [_refine(points, start, up, is_exact=up_world is not None) for start in starts]
    normal, offset, scatter, inside = max(found, key=lambda one: _num_cells(one[3], one[0]))
    area = _CELL**2 * (num_cells := _num_cells(inside, normal))
    if num_cells < min_cells:
        raise MapError(_NO_FLOOR)
    _check_contrast(points, normal, offset)
    sigma = 0.0 if up_world is not None else math.hypot(scatter, shared_sigma)
    if sigma > max_tilt_sigma:
        raise MapError(
            f"the floor is seen over {area:.1f} m2 only, which leaves its tilt open by"
            f" {math.degrees(sigma):.1f} degrees; name the map's up axis, if one is exact: --up z"
        )
    return Floor(normal, offset, area, sigma)


def _refine(
    points: Float[np.ndarray, "n 3"],
    normal: Float[np.ndarray, "3"],
    up_world: Float[np.ndarray, "3"],
    is_exact: bool,
) -> tuple[Float[np.ndarray, "3"], float, float, Float[np.ndarray, "k 3"]]:
    """Return normal, offset, sigma of the tilt and points of the plane near a start. An exact
    normal stays."""
    offset, sigma, num_steps = _lowest_level(points, normal), 0.0, 8
    inside = points[:0]
    for _ in range(num_steps):
        inside = points[np.abs(points @ normal - offset) < _TOLERANCE]
        if len(inside) == 0:
            break
        if is_exact:
            offset = float(np.median(inside @ normal))
        else:
            normal, offset, sigma = _fit_plane(inside, up_world)
    return normal, offset, sigma, inside


def _points_below(
    topomap: TopoMetricMap, up_world: Float[np.ndarray, "3"], max_points: int = 60_000
) -> Float[np.ndarray, "n 3"]:
    """Return points of the map below the cameras that see them, at most `max_points`."""
    max_depth, max_distance = 4.0, 8.0  # metres below a camera, and from it
    found = []
    for node in topomap.nodes:
        pose, points = node.summary.world_from_cam, node.points_cam.astype(float)
        sigmas = np.sqrt((node.point_sqrt_covs.astype(float) ** 2).sum(axis=1))
        world = pose.apply(points)
        depth = (pose.translation - world) @ up_world
        near = (depth > 0.05) & (depth < max_depth) & (sigmas < 2 * _TOLERANCE)
        found.append(world[near & (np.linalg.norm(points, axis=1) < max_distance)])
    points = np.concatenate(found) if found else np.zeros((0, 3))
    if len(points) < 3:
        raise MapError(_NO_FLOOR)
    return points[:: len(points) // max_points + 1]


def _plane_axes(normal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 2"]:
    """Return two unit vectors in the plane of this normal."""
    return np.linalg.svd(normal[None])[2][1:].T


def _num_cells(points: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "3"]) -> int:
    """Return how many cells of the plane hold a point."""
    cells = np.floor(points @ _plane_axes(normal) / _CELL).astype(np.int64)
    return len(np.unique(cells[:, 0] * 1_000_003 + cells[:, 1]))


def _sample_normal(
    points: Float[np.ndarray, "n 3"], up_world: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """Return the normal of the plane through three points that covers most cells."""
    num_samples, min_cosine = 400, math.cos(2.5 * _CAMERA_SIGMA)
    rng, best, most = np.random.default_rng(0), up_world, 0
    for _ in range(num_samples):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < 0.05:
            continue
        normal = normal * np.sign(normal @ up_world) / length
        if normal @ up_world < min_cosine:
            continue
        num = _num_cells(points[np.abs((points - a) @ normal) < _TOLERANCE], normal)
        if num > most:
            best, most = normal, num
    return best


def _check_contrast(
    points: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "3"], offset: float
) -> None:
    """Check that the plane stands out from what lies below it. Raises MapError."""
    # A floor covers this many times the cells of a slab just below it. Seven maps (two corridors,
    # a kitchen, two streets; a room and a shelf where no floor is seen): 3.2 and more, 1.4 and
    # less.
    min_contrast = 2.5
    heights = points @ normal - offset
    num, below = (
        _num_cells(points[np.abs(heights - centre) < _TOLERANCE], normal)
        for centre in (0.0, -3.0 * _TOLERANCE)
    )
    if num < min_contrast * below:
        raise MapError(_NO_FLOOR)


def _lowest_level(points: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "3"]) -> float:
    """Return the height of the lowest large level. It may have less than half of the most cells."""
    min_share = 0.4
    heights = points @ normal
    levels = np.arange(heights.min(), heights.max() + _TOLERANCE, _TOLERANCE)
    cells = [_num_cells(points[np.abs(heights - one) < _TOLERANCE], normal) for one in levels]
    first = int(np.flatnonzero(np.array(cells) >= min_share * max(cells))[0])
    return float(levels[first + int(np.argmax(cells[first : first + 4]))])


def _fit_plane(
    points: Float[np.ndarray, "n 3"], up_world: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "3"], float, float]:
    """Return the normal, the offset and the sigma of the tilt, with the cameras' up as a prior.
    One point a cell counts: points of one thing err together."""
    axes = _plane_axes(up_world)
    flat = points @ axes
    _, rows = np.unique(np.floor(flat / _CELL).astype(np.int64), axis=0, return_index=True)
    flat, heights = flat[rows], (points @ up_world)[rows]
    design = np.column_stack([flat, np.ones(len(flat))])
    information = design.T @ design / (_TOLERANCE / 2) ** 2
    information[:2, :2] += np.eye(2) / _CAMERA_SIGMA**2
    slope_x, slope_y, offset = np.linalg.solve(
        information, design.T @ heights / (_TOLERANCE / 2) ** 2
    )
    normal = up_world - axes @ np.array([slope_x, slope_y])
    norm = float(np.linalg.norm(normal))
    tilt = np.linalg.inv(information)[:2, :2]
    return normal / norm, float(offset) / norm, math.sqrt(np.linalg.eigvalsh(tilt)[1])
