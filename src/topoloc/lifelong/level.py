"""Level a map: find the floor in its points, which gives gravity and the height of the cameras, and
move it to another world.

A floor is the lowest large plane below the cameras. Tables are smaller or higher, and what lies
below the floor (mirror images, wrong matches) is no plane.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from topoloc.errors import MapError
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.map_facts.map_building import with_map_statistics
from topoloc.mapping.edit import WaitCallback, edit_map
from topoloc.mapping.storage.entries import NodeSummary, TopoNode, VirtualNodes
from topoloc.mapping.topomap import Layer, TopoMetricMap
from topoloc.node_ids import LazySequence

_CELL = 0.25  # metres; a plane counts cells, so a textured table weighs no more than its area
_MIN_CELLS = 12
_MAX_DEPTH, _MAX_DISTANCE = 4.0, 8.0  # metres below a camera, and from it
_MAX_TILT = math.radians(25.0)  # of a camera in the hand, on average over a walk
_CAMERA_SIGMA = math.radians(10.0)
_MAX_TILT_SIGMA = math.radians(1.5)
_TOLERANCE = 0.03  # metres
_NUM_SAMPLES, _NUM_STEPS = 400, 8
_MIN_SHARE = 0.4
"""A lower plane of at least this share of the largest one's cells is the floor."""
_MIN_CONTRAST = 2.5
"""A floor covers this many times the cells of a slab just below it. Seven maps (two corridors, a
kitchen, two streets; a room and a shelf where no floor is seen): 3.2 and more, 1.4 and less."""
_NO_FLOOR = (
    "no floor is seen below the cameras; if an axis of the map points up, name it with --up and"
    " give --camera-height, else give three points with heights: --points FILE"
)


@dataclass(frozen=True, eq=False)
class Floor:
    """The plane ``up_world @ x = offset`` (metres) with the area that its points cover (m^2), their
    median distance from it (m), and the sigma of its normal (radians, the weaker direction)."""

    up_world: Float[np.ndarray, "3"]
    offset: float
    area_m2: float
    residual_m: float
    sigma_tilt: float


def find_floor(topomap: TopoMetricMap, up_world: Float[np.ndarray, "3"] | None = None) -> Floor:
    """Find the floor of the map.

    Args:
        up_world: the exact up direction, a unit vector, so that only the height is searched.

    Raises:
        MapError: no floor is seen, or too little to level the map by it.
    """
    is_exact = up_world is not None
    mean = -np.mean([one.world_from_cam.rotation[:, 1] for one in topomap.summaries], axis=0)
    up = mean / np.linalg.norm(mean) if up_world is None else up_world
    points = _points_below(topomap, up)
    best = up if is_exact else _sample_normal(points, up)
    offset, sigma, inside = _lowest_level(points, best), 0.0, points
    for _ in range(_NUM_STEPS):
        inside = points[np.abs(points @ best - offset) < _TOLERANCE]
        if len(inside) == 0 or _num_cells(inside, best) < _MIN_CELLS:
            raise MapError(_NO_FLOOR)
        if is_exact:
            offset = float(np.median(inside @ best))
        else:
            best, offset, sigma = _fit_plane(inside, up)
    _check_contrast(points, best, offset)
    residual = float(np.median(np.abs(inside @ best - offset)))
    area = _CELL**2 * _num_cells(inside, best)
    if sigma > _MAX_TILT_SIGMA:
        raise MapError(
            f"the floor is seen over {area:.1f} m2 only, which leaves its tilt open by"
            f" {math.degrees(sigma):.1f} degrees; name the map's up axis, if one is exact: --up z"
        )
    return Floor(best, offset, area, residual, sigma)


def _points_below(
    topomap: TopoMetricMap, up_world: Float[np.ndarray, "3"], max_points: int = 60_000
) -> Float[np.ndarray, "n 3"]:
    """Return points of the map below the cameras that see them, at most `max_points`."""
    found = []
    for node in topomap.nodes:
        pose, points = node.summary.world_from_cam, node.points_cam.astype(float)
        sigmas = np.sqrt((node.point_sqrt_covs.astype(float) ** 2).sum(axis=1))
        world = pose.apply(points)
        depth = (pose.translation - world) @ up_world
        near = (depth > 0.05) & (depth < _MAX_DEPTH) & (sigmas < 2 * _TOLERANCE)
        found.append(world[near & (np.linalg.norm(points, axis=1) < _MAX_DISTANCE)])
    points = np.concatenate(found) if found else np.zeros((0, 3))
    if len(points) < 3:
        raise MapError(_NO_FLOOR)
    return points[:: len(points) // max_points + 1]


def _plane_axes(normal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 2"]:
    """Return two unit vectors in the plane of this normal."""
    return np.linalg.svd(normal[None])[2][1:].T


def _num_cells(points: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "3"]) -> int:
    cells = np.floor(points @ _plane_axes(normal) / _CELL).astype(np.int64)
    return len(np.unique(cells[:, 0] * 1_000_003 + cells[:, 1]))


def _sample_normal(
    points: Float[np.ndarray, "n 3"], up_world: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """Return the normal of the plane through three points that covers most cells."""
    rng, best, most = np.random.default_rng(0), up_world, 0
    for _ in range(_NUM_SAMPLES):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < 0.05:
            continue
        normal = normal * np.sign(normal @ up_world) / length
        if normal @ up_world < math.cos(_MAX_TILT):
            continue
        num = _num_cells(points[np.abs((points - a) @ normal) < _TOLERANCE], normal)
        if num > most:
            best, most = normal, num
    return best


def _check_contrast(
    points: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "3"], offset: float
) -> None:
    """Check that the plane stands out from what lies below it. Raises MapError."""
    heights = points @ normal - offset
    num, below = (
        _num_cells(points[np.abs(heights - centre) < _TOLERANCE], normal)
        for centre in (0.0, -3.0 * _TOLERANCE)
    )
    if num < _MIN_CONTRAST * below:
        raise MapError(_NO_FLOOR)


def _lowest_level(points: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "3"]) -> float:
    """Return the height of the lowest level with at least `_MIN_SHARE` of the most cells."""
    heights = points @ normal
    levels = np.arange(heights.min(), heights.max() + _TOLERANCE, _TOLERANCE)
    cells = [_num_cells(points[np.abs(heights - one) < _TOLERANCE], normal) for one in levels]
    first = int(np.flatnonzero(np.array(cells) >= _MIN_SHARE * max(cells))[0])
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


def move_map(
    path: str | Path, new_from_old: Rigid3, name: str = "move", on_wait: WaitCallback | None = None
) -> None:
    """Move a map file to another world, as one edit of this name. The history keeps the transform
    as x, y, z, qx, qy, qz, qw. Its place on earth stays.

    Raises:
        MapError: the map is missing, damaged, or cannot be written.
    """
    w, *ijk = new_from_old.quat_wxyz().tolist()
    numbers = (*new_from_old.translation.tolist(), *ijk, w)
    text = " ".join(f"{number:.7g}" for number in numbers)
    with edit_map(path, on_wait) as edit:
        moved = with_map_statistics(move_world(edit.topomap, new_from_old))
        edit.commit(moved, name, {"new_from_old": text})


def move_world(topomap: TopoMetricMap, new_from_old: Rigid3) -> TopoMetricMap:
    """Return the map with all its poses in another world. Its statistics are no longer those of
    its nodes."""

    def move_summary(of: NodeSummary) -> NodeSummary:
        return replace(of, world_from_cam=new_from_old @ of.world_from_cam)

    def move_nodes(nodes: Sequence[TopoNode]) -> Sequence[TopoNode]:
        def read(row: int) -> TopoNode:
            return replace(nodes[row], summary=move_summary(nodes[row].summary))

        return LazySequence(partial(len, nodes), read)

    def move_layer(layer: Layer) -> Layer:
        return replace(layer, nodes=move_nodes(layer.nodes))

    images = topomap.place_images
    known, sides = topomap.georeference, topomap.sides
    if known is not None:
        enu_from_new = known.enu_from_world @ new_from_old.inverse()
        known = replace(known, enu_from_world=enu_from_new)
    return replace(
        topomap,
        summaries=[*map(move_summary, topomap.summaries)],
        layers={kind: move_layer(layer) for kind, layer in topomap.layers.items()},
        place_images=LazySequence(
            partial(len, images),
            lambda row: replace(
                images[row], world_from_cam=new_from_old @ images[row].world_from_cam
            ),
        ),
        sides=None if sides is None else _move_sides(sides, new_from_old, move_summary, move_nodes),
        georeference=known,
    )


def _move_sides(
    sides: VirtualNodes,
    new_from_old: Rigid3,
    move_summary: Callable[[NodeSummary], NodeSummary],
    move_nodes: Callable[[Sequence[TopoNode]], Sequence[TopoNode]],
) -> VirtualNodes:
    """Return the virtual nodes in another world, with the places of their retrieval model."""
    models = {
        name: replace(
            model,
            arrays={**model.arrays, "centres": new_from_old.apply(model.arrays["centres"])},
        )
        for name, model in sides.coarse_models.items()
    }
    summaries = [*map(move_summary, sides.summaries)]
    return replace(sides, summaries=summaries, nodes=move_nodes(sides.nodes), coarse_models=models)
