"""topoloc georeference MAP|ATLAS --origin LAT,LON,H,HEADING | --gnss FILE | --points FILE."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import tyro

from topoloc import GeoPoint, GeoreferenceError, GeoreferenceResult, georeference, open_place
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
        facts = _describe_result(result)
        if self.json != "-":
            _print(result, facts)
        write_json(self.json, facts)
        return 0


def _describe_result(result: GeoreferenceResult) -> dict[str, Any]:
    facts = result.georeference.to_json() | {"heading_deg": result.heading_deg, "up": result.up}
    if result.names:
        facts |= {
            "num_points": len(result.is_inlier),
            "num_used": int(result.is_inlier.sum()),
            "residuals_m": result.residuals_m.round(4).tolist(),
        }
    return facts


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


def _print(result: GeoreferenceResult, facts: dict[str, Any]) -> None:
    heading = f"{facts['heading_deg']:.1f} degrees from true north, clockwise"
    lines = [("origin", str(result.georeference)), ("first picture looks to", heading)]
    if facts["up"] is not None:
        lines.append(("up", f"the world's {facts['up']}"))
    if result.names:
        worst = int(np.argmax(np.where(result.is_inlier, result.residuals_m, -1.0)))
        largest = f"{result.residuals_m[worst]:.3f} m ({result.names[worst]})"
        lines.append(("points", f"{facts['num_used']} of {facts['num_points']} agree"))
        lines.append(("residuals", f"rms {result.georeference.rms_m:.3f} m, largest {largest}"))
        if len(outliers := np.flatnonzero(~result.is_inlier).tolist()):
            names = [result.names[k] for k in outliers[:5]] + ["..."] * (len(outliers) > 5)
            lines.append(("left out", ", ".join(names)))
    print_fields(lines)
