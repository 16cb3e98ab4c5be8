"""topoloc georeference MAP|ATLAS --origin LAT,LON,H,HEADING | --gnss FILE | --points FILE."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import tyro

from topoloc import GeoPoint, GeoreferenceError, georeference, open_place
from topoloc.apps.cli.output import (
    File,
    UsageError,
    check_outputs,
    option,
    print_fields,
    print_waiting,
    write_json,
)
from topoloc.apps.cli.tile_option import TileOption, select_tile


@dataclass(frozen=True)
class Command:
    """Options of `topoloc georeference`."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP|ATLAS")]
    """The map file, which is replaced by a georeferenced one. Or an atlas, with `--tile`."""
    origin: Annotated[str | None, option("LAT,LON,H,HEADING")] = None
    """Position of the first mapping image (degrees, metres above the ellipsoid) and its heading in
    degrees clockwise from true north."""
    gnss: File = None
    """Positions of the camera, fitted robustly: lines of `time,lat,lon,h` or
    `name of a mapping image,lat,lon,h`."""
    points: File = None
    """Three or more known points: lines of `x,y,z,lat,lon,h`, with x, y, z in metres in the map's
    world."""
    up: Annotated[str | None, option("x|-x|y|-y|z|-z", "the axis nearest to the cameras' up")] = (
        None
    )
    """The axis of the map's world that points up. --points does not need it."""
    tile: TileOption = None
    """The tile of an atlas. Tiles that share its world or are joined with it are then georeferenced
    too."""
    json: File = None
    """Write the result as JSON to this file (- for standard output)."""

    def run(self) -> int:
        given = [option for option in (self.origin, self.gnss, self.points) if option is not None]
        if len(given) != 1:
            raise UsageError("georeference takes a map and one of --origin, --gnss and --points")
        check_outputs([self.json], [self.map, self.gnss, self.points])
        origin = None if self.origin is None else _parse_origin(self.origin)
        place = open_place(self.map)
        result = place.edit(
            select_tile(place, self.tile),
            lambda path: georeference(path, origin, self.gnss, self.points, self.up, print_waiting),
        )
        facts = result.georeference.to_json() | {"heading_deg": result.heading_deg, "up": result.up}
        if result.names:
            left_out = np.flatnonzero(~result.is_inlier).tolist()
            facts |= {
                "num_points": len(result.is_inlier),
                "num_used": int(result.is_inlier.sum()),
                "residuals_m": result.residuals_m.round(4).tolist(),
                "names": list(result.names),
                "left_out": [result.names[k] for k in left_out],
            }
        if self.json != "-":
            _print(str(result.georeference), facts)
        write_json(self.json, facts)
        return 0


def _parse_origin(text: str) -> tuple[GeoPoint, float]:
    try:
        lat, lon, h, heading_deg = map(float, text.split(","))
    except ValueError:
        raise GeoreferenceError(
            f"--origin {text[:80]}: four numbers LAT,LON,H,HEADING are needed"
        ) from None
    if not -360.0 <= heading_deg <= 360.0:
        raise GeoreferenceError(
            f"--origin: a heading of {heading_deg:g}; degrees clockwise from true north are needed"
        )
    return GeoPoint(lat, lon, h), heading_deg


def _print(origin: str, facts: dict[str, Any]) -> None:
    heading = f"{facts['heading_deg']:.1f} degrees from true north, clockwise"
    lines = [("origin", origin), ("first picture looks to", heading)]
    if facts["up"] is not None:
        lines.append(("up", f"the world's {facts['up']}"))
    if "names" in facts:
        residuals = zip(facts["residuals_m"], facts["names"], strict=True)
        worst, name = max(one for one in residuals if one[1] not in facts["left_out"])
        lines.append(("points", f"{facts['num_used']} of {facts['num_points']} agree"))
        largest = f"largest {worst:.3f} m ({name})"
        lines.append(("residuals", f"rms {facts['rms_m']:.3f} m, {largest}"))
        if left_out := facts["left_out"]:
            names = left_out[:5] + ["..."] * (len(left_out) > 5)
            lines.append(("left out", ", ".join(names)))
    print_fields(lines)
