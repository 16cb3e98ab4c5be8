"""topoloc level MAP [--pose X,Y,HEADING | --points FILE]

The world that a robot expects of a map: z up, the floor at z = 0 (REP 103, REP 105), and x and y as
in its plan. Gravity comes from the floor, from a named axis, or from the place on earth. The
horizontal frame is that of the first mapping image, of its known pose, or of points that are known
in the plan, such as the `map.yaml` of a robot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from jaxtyping import Float

from topoloc import MapError, Rigid3, TopoMetricMap, move_map
from topoloc.apps.cli.maps.floor import find_floor
from topoloc.apps.cli.output import (
    File,
    UsageError,
    check_outputs,
    option,
    print_fields,
    print_waiting,
    write_json,
)
from topoloc.plugin import read_text

_Axis = Literal["x", "-x", "y", "-y", "z", "-z"]


@dataclass(frozen=True)
class Command:
    """Options of `topoloc level`."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP")]
    """The map file, which is replaced by one whose world has z up and the floor at z = 0."""
    pose: Annotated[str | None, option("X,Y,HEADING", "0,0,0")] = None
    """Pose of the first mapping image in the new world, such as the frame of a robot's map.yaml:
    metres, and degrees counter-clockwise from x."""
    points: File = None
    """Two or more points of both worlds, instead of --pose: lines of `x,y,z,new x,new y` or `name
    of a mapping image,new x,new y`. Three with a new z need no floor."""
    up: Annotated[_Axis | None, option("x|-x|y|-y|z|-z", "found by the floor")] = None
    """The axis of the map's world that points up exactly."""
    camera_height: Annotated[float | None, option("METRES", "found by the floor")] = None
    """Median height of the mapping cameras above the floor."""
    json: File = None
    """Write the result as JSON to this file (- for standard output)."""

    def run(self) -> int:
        if self.pose is not None and self.points is not None:
            raise UsageError("level takes one of --pose and --points")
        if self.camera_height is not None and not 0.0 < self.camera_height < math.inf:
            raise UsageError(f"--camera-height {self.camera_height:g}: metres above the floor")
        check_outputs([self.json], [self.map, self.points])
        pose = (0.0, 0.0, 0.0) if self.pose is None else _parse_pose(self.pose)
        level = find_and_move(self.map, pose, self.points, self.up, self.camera_height)
        if self.json != "-":
            _print(level)
        facts = {
            "new_from_old": level.new_from_old.tolist(),
            "camera_height_m": level.camera_height_m,
            "floor_m2": level.floor_m2,
            "sigma_tilt_deg": level.sigma_tilt_deg,
            "residuals_m": level.residuals_m.round(4).tolist(),
        }
        write_json(self.json, facts)
        return 0


def find_and_move(
    path: str,
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0),
    points: str | None = None,
    up: str | None = None,
    camera_height: float | None = None,
) -> LevelWorld:
    """Give a map file its level world, see `find_level_world`. Raises MapError."""
    with TopoMetricMap.load(path) as topomap, MapError.at(path):
        if not topomap.summaries:
            raise MapError("it has no mapping picture")
        topomap.require_scale("the height of the floor")
        known = None if points is None else read_plan(Path(points), topomap)
        level = find_level_world(topomap, pose, known, up, camera_height)
    move_map(path, level.new_from_old, "level", print_waiting)
    return level


def _parse_pose(text: str) -> tuple[float, float, float]:
    try:
        x, y, heading_deg = map(float, text.split(","))
    except ValueError:
        x = y = heading_deg = math.nan
    if not all(map(math.isfinite, (x, y, heading_deg))):
        raise UsageError(f"--pose {text[:80]}: three numbers X,Y,HEADING are needed")
    return x, y, heading_deg


def _print(level: LevelWorld) -> None:
    lines = [("cameras", f"{level.camera_height_m:.2f} m above the floor")]
    if level.floor_m2:
        tilt = f"tilt +- {level.sigma_tilt_deg:.2f} degrees"
        lines.append(("floor", f"{level.floor_m2:.1f} m2 seen, {tilt}"))
    if len(level.residuals_m):
        lines.append(("points", f"within {level.residuals_m.max():.3f} m"))
    print_fields(lines)


@dataclass(frozen=True, eq=False)
class LevelWorld:
    """Hold the transform of the world before to the level one. `camera_height_m` is the median
    height of the cameras. `floor_m2` and `sigma_tilt_deg` are the area of the floor that is seen,
    and the accuracy of gravity by it, 0 if it was not searched. `residuals_m` are those of the
    plan's points."""

    new_from_old: Rigid3
    camera_height_m: float
    floor_m2: float = 0.0
    sigma_tilt_deg: float = 0.0
    residuals_m: Float[np.ndarray, " n"] = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, eq=False)
class Plan:
    """Points of the world (n, 3) and of the plan (n, 2), or (n, 3) if heights are known, metres.
    `path` is their file."""

    path: Path
    world: Float[np.ndarray, "n 3"]
    plan: Float[np.ndarray, "n d"]


def find_level_world(
    topomap: TopoMetricMap,
    pose: tuple[float, float, float],
    known: Plan | None,
    up: str | None,
    camera_height: float | None,
) -> LevelWorld:
    """Return the level world of a map.

    Args:
        pose: x, y (metres) and heading (degrees, counter-clockwise from x) of the first mapping
            image in the new world, if no points are known.
        up: the axis of the map's world that is up exactly (`z`, `-y`). By default gravity is known
            from the georeference, or found by the floor.
        camera_height: median height of the mapping cameras above the floor (metres). By default the
            floor is searched.

    Raises:
        MapError: no floor is seen, or the points do not determine the plan.
    """
    area = sigma = 0.0
    residuals = np.zeros(0)
    if known is not None and known.plan.shape[1] == 3:
        new_from_old = _fit_points(known)
        residuals = _check_plan(known, new_from_old)
    else:
        up_world, offset, area, sigma = _find_vertical(topomap, up, camera_height)
        upright = _upright_from_world(topomap, up_world, offset)
        if known is None:
            new_from_old = _plan_from_pose(*pose) @ upright
        else:
            new_from_old = _fit_plan(known, upright) @ upright
            residuals = _check_plan(known, new_from_old)
    height = _median_height(topomap, new_from_old.rotation[2]) + new_from_old.translation[2]
    return LevelWorld(new_from_old, height, area, sigma, residuals)


def _find_vertical(
    topomap: TopoMetricMap, up: str | None, camera_height: float | None
) -> tuple[Float[np.ndarray, "3"], float, float, float]:
    """Return the up direction in the world, the height of the floor along it, and the floor's area
    and sigma, see `LevelWorld`. Raises MapError."""
    known, area, sigma, offset = None, 0.0, 0.0, 0.0
    if up is not None:
        known = np.eye(3)["xyz".index(up[-1])] * (-1.0 if up.startswith("-") else 1.0)
    elif topomap.georeference is not None:
        known = topomap.georeference.enu_from_world.rotation[2]
    if known is None or camera_height is None:
        floor = find_floor(topomap, known)
        known, offset, area, sigma = floor.up_world, floor.offset, floor.area_m2, floor.sigma_tilt
    if camera_height is not None:
        offset = _median_height(topomap, known) - camera_height
    return known, offset, area, math.degrees(sigma)


def _median_height(topomap: TopoMetricMap, up_world: Float[np.ndarray, "3"]) -> float:
    """Return the median height of the mapping cameras, metres along a direction of the world."""
    heights = [one.world_from_cam.translation @ up_world for one in topomap.summaries]
    return float(np.median(heights))


def _upright_from_world(
    topomap: TopoMetricMap, up_world: Float[np.ndarray, "3"], offset: float
) -> Rigid3:
    """Return the transform to axes with z up: x is the heading of the first mapping image, the
    origin the point of the floor below it. If it looks up or down, x is its upper
    side."""
    min_norm = math.sin(math.radians(10.0))  # a camera that looks up or down has no heading
    first = topomap.summaries[0].world_from_cam
    for direction in (first.rotation[:, 2], -first.rotation[:, 1]):
        level = direction - (direction @ up_world) * up_world
        if np.linalg.norm(level) >= min_norm:
            break
    forward = level / np.linalg.norm(level)
    rotation = np.array([forward, np.cross(up_world, forward), up_world])
    height = first.translation @ up_world - offset
    return Rigid3(rotation, np.array([0.0, 0.0, height]) - rotation @ first.translation)


def _plan_from_pose(x: float, y: float, heading_deg: float) -> Rigid3:
    turn = Rigid3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, math.radians(heading_deg)]))
    return Rigid3(turn.rotation, np.array([x, y, 0.0]))


def _fit_plan(known: Plan, upright_from_world: Rigid3) -> Rigid3:
    """Return the turn about z and the shift from known points. Raises MapError."""
    min_base = 0.5  # metres between two points
    flat = upright_from_world.apply(known.world)[:, :2]
    a, b = flat - flat.mean(axis=0), known.plan - known.plan.mean(axis=0)
    base = 2.0 * float(np.linalg.norm(a, axis=1).max())
    if base < min_base:
        raise MapError(f"{known.path}: the points are {base:.2f} m apart; take points metres apart")
    sine, cosine = np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b)
    turn = Rigid3.exp(np.array([0.0] * 5 + [math.atan2(sine, cosine)])).rotation
    shift = known.plan.mean(axis=0) - turn[:2, :2] @ flat.mean(axis=0)
    return Rigid3(turn, np.array([*shift, 0.0]))


def _fit_points(known: Plan) -> Rigid3:
    """Return the rigid transform from points with heights (Umeyama, 1991). Raises MapError."""
    centre_world, centre_plan = known.world.mean(axis=0), known.plan.mean(axis=0)
    correlation = (known.plan - centre_plan).T @ (known.world - centre_world)
    u, spread, vt = np.linalg.svd(correlation)
    if spread[1] <= 1e-6 * max(spread[0], 1.0):
        raise MapError(f"{known.path}: the points lie on one line, which leaves the tilt open")
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return Rigid3(rotation, centre_plan - rotation @ centre_world)


def _check_plan(known: Plan, new_from_old: Rigid3) -> Float[np.ndarray, " n"]:
    """Return the residuals of the points (metres). Raises MapError: they are too large."""
    max_share = 0.1  # of the extent of the points
    moved = new_from_old.apply(known.world)[:, : known.plan.shape[1]]
    residuals = np.linalg.norm(moved - known.plan, axis=1)
    extent = float(np.linalg.norm(known.plan - known.plan.mean(axis=0), axis=1).max())
    if residuals.max() > max_share * extent:
        worst = int(residuals.argmax())
        raise MapError(
            f"{known.path}: the points contradict each other by up to {residuals[worst]:.2f} m"
            f" (point {worst + 1}): not the same places, x and y swapped, or a mirrored plan"
        )
    return residuals


def read_plan(path: Path, topomap: TopoMetricMap) -> Plan:
    """Read points of both worlds: lines of `x, y, z, new x, new y` or `name of a mapping image, new
    x, new y`, and a new z if it is known. Raises MapError."""
    positions = {
        one.name: one.world_from_cam.translation
        for one in (*topomap.place_images, *topomap.summaries)
    }
    world, plan = [], []
    lines = read_text(path, MapError).replace(",", " ").splitlines()
    for number, columns in enumerate(map(str.split, lines), 1):
        if not columns or columns[0].startswith("#"):
            continue
        is_named = len(columns) < 5
        try:
            numbers = [float(text) for text in columns[is_named:]]
        except ValueError:
            numbers = []
        if is_named and columns[0] not in positions:
            raise MapError(
                f"{path}, line {number}: no mapping picture is named {columns[0][:50]!r}"
            )
        point = numbers if is_named else numbers[3:]
        if len(point) not in (2, 3) or not np.isfinite(numbers).all():
            raise MapError(
                f"{path}, line {number}: `x, y, z, new x, new y` or `image name, new x, new y` is"
                " needed"
            )
        world.append(positions[columns[0]] if is_named else np.array(numbers[:3]))
        plan.append(point)
    if len({len(point) for point in plan}) > 1:
        raise MapError(f"{path}: all points have a new z, or none")
    if not plan or len(plan) < len(plan[0]):
        raise MapError(f"{path}: {len(plan)} of at least {len(plan[0]) if plan else 2} points")
    return Plan(path, np.array(world), np.array(plan))
