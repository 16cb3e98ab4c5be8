"""topoloc level MAP [--pose X,Y,HEADING | --points FILE]."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import tyro

from topoloc import LevelResult, level_map
from topoloc.apps.cli.output import (
    File,
    UsageError,
    check_outputs,
    option,
    print_fields,
    print_waiting,
    write_json,
)


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
    up: Annotated[str | None, option("x|-x|y|-y|z|-z", "found by the floor")] = None
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
        pose = None if self.pose is None else _parse_pose(self.pose)
        result = level_map(self.map, pose, self.points, self.up, self.camera_height, print_waiting)
        if self.json != "-":
            _print(result)
        floor = result.floor
        facts = {
            "new_from_old": result.new_from_old.tolist(),
            "tilt_deg": result.tilt_deg,
            "camera_height_m": result.camera_height_m,
            "floor_m2": None if floor is None else floor.area_m2,
            "sigma_tilt_deg": None if floor is None else math.degrees(floor.sigma_tilt),
            "residuals_m": result.residuals_m.round(4).tolist(),
        }
        write_json(self.json, facts)
        return 0


def _parse_pose(text: str) -> tuple[float, float, float]:
    try:
        x, y, heading_deg = map(float, text.split(","))
    except ValueError:
        x = y = heading_deg = math.nan
    if not all(map(math.isfinite, (x, y, heading_deg))):
        raise UsageError(f"--pose {text[:80]}: three numbers X,Y,HEADING are needed")
    return x, y, heading_deg


def _print(result: LevelResult) -> None:
    lines = [("turned by", f"{result.tilt_deg:.2f} degrees from the nearest axis")]
    if (floor := result.floor) is not None:
        seen = f"{floor.area_m2:.1f} m2 seen, within {100 * floor.residual_m:.1f} cm"
        lines.append(("floor", f"{seen}, tilt +- {math.degrees(floor.sigma_tilt):.2f} degrees"))
    lines.append(("cameras", f"{result.camera_height_m:.2f} m above the floor"))
    if len(result.residuals_m):
        lines.append(("points", f"within {result.residuals_m.max():.3f} m"))
    print_fields(lines)
