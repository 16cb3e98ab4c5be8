"""Give a map a world as robots expect it: z up, the floor at z = 0, metres (REP 103, REP 105).

Gravity comes from the floor, or from a named axis. The horizontal frame is that of the first
mapping image, of its known pose, or of points that are known in another plan, such as the
`map.yaml` of a robot. All poses of the map change, and no distance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from topoloc.errors import MapError, TrajectoryError
from topoloc.geometry.alignment import align_points
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.json_data import OneLine
from topoloc.lifelong.floor import Floor, find_floor
from topoloc.localization.map_facts.map_building import with_map_statistics
from topoloc.mapping.edit import WaitCallback, edit_map
from topoloc.mapping.georeference import find_positions_by_name
from topoloc.mapping.georeferencing import estimate_up_direction
from topoloc.mapping.storage.entries import NodeSummary, TopoNode, VirtualNodes
from topoloc.mapping.topomap import Layer, TopoMetricMap
from topoloc.node_ids import LazySequence
from topoloc.recordings.text_files import read_rows

_MIN_BASE = 0.5  # metres between two points of a plan
_MAX_RESIDUAL_SHARE = 0.1
_MIN_HORIZONTAL_NORM = math.sin(math.radians(10.0))


@dataclass(frozen=True, eq=False, repr=False)
class LevelResult(OneLine):
    """`new_from_old` transforms the world before to the level one. `tilt_deg` is the angle between
    the old axis nearest to up and up. `floor` is None if the floor was not searched. `residuals_m`
    are those of the plan's points."""

    new_from_old: Rigid3
    tilt_deg: float
    camera_height_m: float
    floor: Floor | None
    residuals_m: Float[np.ndarray, " n"]


def level_map(
    path: str | Path,
    pose: tuple[float, float, float] | None = None,
    points: str | Path | None = None,
    up: str | None = None,
    camera_height: float | None = None,
    on_wait: WaitCallback | None = None,
) -> LevelResult:
    """Give a map file a world with z up and the floor at z = 0, as one edit.

    Args:
        path: the map file, which is replaced.
        pose: x, y (metres) and heading (degrees, counter-clockwise from x) of the first mapping
            image in the new world. By default 0, 0, 0: x is where it looks.
        points: a file of two or more points in both worlds, lines of `x, y, z, new x, new y` or
            `image name, new x, new y` (metres; the camera's place), instead of `pose`. Three or
            more with a new z after it determine gravity and the floor, too.
        up: the axis of the map's world that is up exactly (`z`, `-y`). By default gravity is known
            from the georeference, or found by the floor.
        camera_height: median height of the mapping cameras above the floor (metres). By default the
            floor is searched.
        on_wait: called if another process edits the map, before this one waits.

    Raises:
        ValueError: both `pose` and `points` are given.
        MapError: no floor is seen, the points do not determine the plan, or the map is missing,
            damaged, or cannot be written.
    """
    if pose is not None and points is not None:
        raise ValueError("level takes one of pose and points")
    with edit_map(path, on_wait) as edit:
        topomap = edit.topomap
        if not topomap.summaries:
            raise MapError(f"map {path} has no mapping picture")
        known = None if points is None else _read_plan(Path(points), topomap)
        floor, residuals = None, np.zeros(0)
        if known is not None and known.plan.shape[1] == 3:
            with MapError.at(str(points), TrajectoryError):
                new_from_old = align_points(known.plan, known.world)
            residuals = _check_plan(known, new_from_old)
        else:
            with MapError.at(str(path)):
                up_world, floor, offset = _find_vertical(topomap, up, camera_height)
            upright = _upright_from_world(topomap, up_world, offset)
            new_from_old = _plan_from_pose(*(pose or (0.0, 0.0, 0.0))) @ upright
            if known is not None:
                new_from_old = _fit_plan(known, upright) @ upright
                residuals = _check_plan(known, new_from_old)
        levelled = with_map_statistics(move_world(topomap, new_from_old))
        edit.commit(levelled, "level", {"new_from_old": _to_text(new_from_old)})
    nearest = estimate_up_direction([one.world_from_cam for one in topomap.summaries])
    heights = [new_from_old.apply(one.world_from_cam.translation)[2] for one in topomap.summaries]
    tilt = math.degrees(math.acos(min(1.0, float(new_from_old.rotation[2] @ nearest.world))))
    return LevelResult(new_from_old, tilt, float(np.median(heights)), floor, residuals)


def _to_text(pose: Rigid3) -> str:
    """Return x, y, z, qx, qy, qz, qw, as a line of a TUM file has them."""
    w, *ijk = pose.quat_wxyz().tolist()
    return " ".join(f"{number:.7g}" for number in (*pose.translation.tolist(), *ijk, w))


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


def _find_vertical(
    topomap: TopoMetricMap, up: str | None, camera_height: float | None
) -> tuple[Float[np.ndarray, "3"], Floor | None, float]:
    """Return the up direction in the world, the floor if it was searched, and its height along
    this direction. Raises MapError."""
    known = None
    if up is not None:
        known = estimate_up_direction([], up).world
    elif topomap.georeference is not None:
        known = topomap.georeference.enu_from_world.rotation[2]
    if known is not None and camera_height is not None:
        heights = [one.world_from_cam.translation @ known for one in topomap.summaries]
        return known, None, float(np.median(heights)) - camera_height
    floor = find_floor(topomap, known, is_exact=known is not None)
    offset = floor.offset
    if camera_height is not None:
        heights = [one.world_from_cam.translation @ floor.up_world for one in topomap.summaries]
        offset = float(np.median(heights)) - camera_height
    return floor.up_world, floor, offset


def _upright_from_world(
    topomap: TopoMetricMap, up_world: Float[np.ndarray, "3"], offset: float
) -> Rigid3:
    """Return the transform to axes with z up: x is the heading of the first mapping image, the
    origin the point of the floor below it. Raises MapError: it looks up or down."""
    first = topomap.summaries[0].world_from_cam
    for direction in (first.rotation[:, 2], -first.rotation[:, 1]):
        level = direction - (direction @ up_world) * up_world
        if np.linalg.norm(level) >= _MIN_HORIZONTAL_NORM:
            break
    forward = level / np.linalg.norm(level)
    rotation = np.array([forward, np.cross(up_world, forward), up_world])
    height = first.translation @ up_world - offset
    return Rigid3(rotation, np.array([0.0, 0.0, height]) - rotation @ first.translation)


def _plan_from_pose(x: float, y: float, heading_deg: float) -> Rigid3:
    turn = exp_so3(np.array([0.0, 0.0, math.radians(heading_deg)]))
    return Rigid3(turn, np.array([x, y, 0.0]))


@dataclass(frozen=True, eq=False)
class _Plan:
    """Points of the world (n, 3) and of the plan (n, 2), or (n, 3) if heights are known. `path` is
    their file."""

    path: Path
    world: Float[np.ndarray, "n 3"]
    plan: Float[np.ndarray, "n d"]


def _fit_plan(known: _Plan, upright_from_world: Rigid3) -> Rigid3:
    """Return the turn about z and the shift from known points. Raises MapError."""
    flat = upright_from_world.apply(known.world)[:, :2]
    a, b = flat - flat.mean(axis=0), known.plan - known.plan.mean(axis=0)
    base = 2.0 * float(np.linalg.norm(a, axis=1).max())
    if base < _MIN_BASE:
        raise MapError(f"{known.path}: the points are {base:.2f} m apart; take points metres apart")
    sine, cosine = np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b)
    turn = exp_so3(np.array([0.0, 0.0, math.atan2(sine, cosine)]))
    shift = known.plan.mean(axis=0) - turn[:2, :2] @ flat.mean(axis=0)
    return Rigid3(turn, np.array([*shift, 0.0]))


def _check_plan(known: _Plan, new_from_old: Rigid3) -> Float[np.ndarray, " n"]:
    """Return the residuals of the points (metres). Raises MapError: they are too large."""
    moved = new_from_old.apply(known.world)[:, : known.plan.shape[1]]
    residuals = np.linalg.norm(moved - known.plan, axis=1)
    extent = float(np.linalg.norm(known.plan - known.plan.mean(axis=0), axis=1).max())
    if residuals.max() > _MAX_RESIDUAL_SHARE * extent:
        worst = int(residuals.argmax())
        raise MapError(
            f"{known.path}: the points contradict each other by up to {residuals[worst]:.2f} m"
            f" (point {worst + 1}): not the same places, x and y swapped, or a mirrored plan"
        )
    return residuals


def _read_plan(path: Path, topomap: TopoMetricMap) -> _Plan:
    """Read points of the world with their places in the plan. Raises MapError."""
    positions, world, plan = find_positions_by_name(topomap), [], []
    for line, columns in read_rows(path, MapError):
        is_named = len(columns) < 5
        try:
            numbers = [float(text) for text in columns[is_named:]]
        except ValueError:
            numbers = []
        if is_named and columns[0] not in positions:
            raise MapError(f"{path}, line {line}: no mapping picture is named {columns[0][:60]!r}")
        place = positions[columns[0]] if is_named else np.array(numbers[:3])
        point = numbers if is_named else numbers[3:]
        if len(point) not in (2, 3) or not np.isfinite(numbers).all():
            raise MapError(
                f"{path}, line {line}: `x, y, z, new x, new y` or `image name, new x, new y` is"
                " needed"
            )
        world.append(place)
        plan.append(point)
    if len({len(point) for point in plan}) > 1:
        raise MapError(f"{path}: all points have a new z, or none")
    if len(plan) < len(plan[0]):
        raise MapError(f"{path}: {len(plan)} of at least {len(plan[0])} points")
    return _Plan(path, np.array(world), np.array(plan))
