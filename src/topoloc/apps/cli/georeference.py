"""topoloc georeference MAP|ATLAS --origin LAT,LON,H,HEADING | --gnss FILE | --points FILE."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from topoloc import GeoPoint, Georeference, GeoreferenceError, Rigid3, TopoMetricMap
from topoloc.apps.cli.output import File, UsageError, check_outputs, print_fields, write_json
from topoloc.apps.cli.tile_option import TileOption, edit_map_or_tile
from topoloc.apps.cli.wait_message import print_waiting
from topoloc.mapping.control_points import ControlPoints, read_control_points, read_gnss
from topoloc.mapping.edit import edit_map
from topoloc.mapping.georeferencing import (
    GeoreferenceFit,
    UpDirection,
    estimate_up_direction,
    fit_georeference,
    georeference_from_heading,
)


@dataclass(frozen=True)
class Command:
    """What `topoloc georeference` takes."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP|ATLAS")]
    """The map file; it is replaced by one that knows where on earth it lies. Or an atlas, with
    `--tile`."""
    origin: Annotated[
        str | None, tyro.conf.arg(metavar="LAT,LON,H,HEADING", help_behavior_hint="")
    ] = None
    """Where the first mapping picture was taken (degrees, metres above the ellipsoid), and which
    way it looks: degrees clockwise from true north."""
    gnss: File = None
    """Where the camera was: lines of `time,lat,lon,h` or `name of a mapping picture,lat,lon,h`;
    fitted robustly."""
    points: File = None
    """Three or more known points: lines of `x,y,z,lat,lon,h`, x, y, z metres in the map's world."""
    up: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="x|-x|y|-y|z|-z",
            help_behavior_hint="(default: the axis nearest to the cameras' up)",
        ),
    ] = None
    """The axis of the map's world that is up; --points do not need it."""
    tile: TileOption = None
    """Of an atlas: the tile; those that share its world, or are joined with it, then know where
    they lie, too."""
    json: File = None
    """Write what is printed as JSON to this file (- for standard output)."""

    def run(self) -> int:
        given = [option for option in (self.origin, self.gnss, self.points) if option is not None]
        if len(given) != 1:
            raise UsageError("georeference takes a map and one of --origin, --gnss and --points")
        check_outputs(
            [self.json], inputs=[path for path in (self.map, self.gnss, self.points) if path]
        )
        origin = None if self.origin is None else _parse_origin(self.origin)
        found, facts, fitted = edit_map_or_tile(
            self.map, self.tile, lambda path: self._edit_georeference(path, origin)
        )
        if self.json != "-":
            _print(found, facts, fitted)
        write_json(self.json, facts)
        return 0

    def _edit_georeference(
        self, path: Path, origin: tuple[GeoPoint, float] | None
    ) -> tuple[Georeference, dict[str, Any], tuple[ControlPoints, GeoreferenceFit] | None]:
        """Where the map lies, with what is said of it, and what it was fitted to."""
        with edit_map(path, print_waiting) as edit:
            topomap = edit.topomap
            posed = [image.world_from_cam for image in topomap.place_images] or [
                s.world_from_cam for s in topomap.summaries
            ]
            if not posed:
                raise GeoreferenceError(f"map {path} has no mapping picture")
            up = estimate_up_direction(posed, self.up)
            found, fitted = self._estimate_georeference(topomap, posed[0], up, origin)
            edit.commit(replace(topomap, georeference=found), f"georeference {found.source}")
        facts = found.to_json() | {
            "heading_deg": found.heading_deg(posed[0].rotation[:, 2]),
            "up": None if self.points else up.axis,
        }
        if fitted is not None:
            fit = fitted[1]
            facts |= {
                "num_points": len(fit.is_inlier),
                "num_used": int(fit.is_inlier.sum()),
                "residuals_m": fit.residuals_m.round(4).tolist(),
            }
        return found, facts, fitted

    def _estimate_georeference(
        self,
        topomap: TopoMetricMap,
        first: Rigid3,
        up: UpDirection,
        origin: tuple[GeoPoint, float] | None,
    ) -> tuple[Georeference, tuple[ControlPoints, GeoreferenceFit] | None]:
        """Where the map lies, and what that was fitted to."""
        if origin is not None:
            return georeference_from_heading(first, *origin, up), None
        if self.points is not None:
            known = read_control_points(Path(self.points))
            fit = fit_georeference(known.points_world, known.places, "points")
        else:
            known = read_gnss(Path(self.gnss or ""), topomap)
            fit = fit_georeference(known.points_world, known.places, "gnss", up)
        return fit.georeference, (known, fit)


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


def format_georeference(georeference: Georeference) -> str:
    """Where a map lies, and how well that is known, in one line."""
    o, rms = georeference.origin, georeference.rms_m
    fitted = "" if rms is None else f", rms {rms:.2f} m"
    return f"{o.lat:.7f}, {o.lon:.7f}, {o.h:.2f} m (from {georeference.source}{fitted})"


def _print(
    found: Georeference, facts: dict[str, Any], fitted: tuple[ControlPoints, GeoreferenceFit] | None
) -> None:
    lines = [
        ("origin", format_georeference(found)),
        (
            "first picture looks to",
            f"{facts['heading_deg']:.1f} degrees from true north, clockwise",
        ),
    ]
    if facts["up"] is not None:
        lines.append(("up", f"the world's {facts['up']}"))
    if fitted is not None:
        known, fit = fitted
        worst = int(np.argmax(np.where(fit.is_inlier, fit.residuals_m, -1.0)))
        lines.append(("points", f"{facts['num_used']} of {facts['num_points']} agree"))
        lines.append(
            (
                "residuals",
                (
                    f"rms {found.rms_m:.3f} m, largest {fit.residuals_m[worst]:.3f} m"
                    f" ({known.names[worst]})"
                ),
            )
        )
        if not fit.is_inlier.all():
            left_out = ", ".join(
                known.names[k] for k in np.flatnonzero(~fit.is_inlier)[:5].tolist()
            )
            lines.append(("left out", f"{left_out}{', ...' if (~fit.is_inlier).sum() > 5 else ''}"))
    print_fields(lines)
