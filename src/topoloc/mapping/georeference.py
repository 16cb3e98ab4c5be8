"""A map file gets its place on earth: from its first image, or fitted to known places."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from topoloc.errors import GeoreferenceError
from topoloc.geometry.geodesy import GeoPoint, Georeference
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.control_points import ControlPoints, read_control_points, read_gnss
from topoloc.mapping.edit import WaitCallback, edit_map
from topoloc.mapping.georeferencing import (
    GeoreferenceFit,
    UpDirection,
    estimate_up_direction,
    fit_georeference,
    georeference_from_heading,
)
from topoloc.mapping.topomap import TopoMetricMap

_Fitted = tuple[ControlPoints, GeoreferenceFit]


@dataclass(frozen=True, eq=False)
class GeoreferenceResult:
    """The georeference of a map, the heading of its first image (degrees clockwise from true
    north), and the axis of the world that is up (None if points determined it).

    A fit also has the names of the points, their residuals (m), and whether the fit used them.
    """

    georeference: Georeference
    heading_deg: float
    up: str | None
    names: list[str]
    residuals_m: Float[np.ndarray, " n"]
    is_inlier: Bool[np.ndarray, " n"]


def georeference(
    path: str | Path,
    origin: tuple[GeoPoint, float] | None = None,
    gnss: str | Path | None = None,
    points: str | Path | None = None,
    up: str | None = None,
    on_wait: WaitCallback | None = None,
) -> GeoreferenceResult:
    """Store in a map file where on earth it lies, by exactly one of three sources.

    Args:
        path: the map file, which is replaced.
        origin: the place of the first mapping image, and its heading in degrees clockwise from
            true north.
        gnss: a file of the camera's places, lines of `time or image name, lat, lon, h`.
        points: a file of three or more known points, lines of `x, y, z, lat, lon, h`.
        up: the axis of the map's world that is up (`z`, `-y`); by default the one nearest to the
            cameras' up.
        on_wait: called if another process edits the map, before this one waits.

    Raises:
        ValueError: not exactly one source is given.
        GeoreferenceError: a file is malformed, or the points do not determine the transform.
        MapError: the map is missing, damaged, or cannot be written.
    """
    if sum(source is not None for source in (origin, gnss, points)) != 1:
        raise ValueError("georeference takes one of origin, gnss and points")
    with edit_map(path, on_wait) as edit:
        topomap = edit.topomap
        posed = [image.world_from_cam for image in topomap.place_images] or [
            summary.world_from_cam for summary in topomap.summaries
        ]
        if not posed:
            raise GeoreferenceError(f"map {path} has no mapping picture")
        direction = estimate_up_direction(posed, up)
        if origin is not None:
            found, fitted = georeference_from_heading(posed[0], *origin, direction), None
        else:
            fitted = _fit(topomap, gnss, points, direction)
            found = fitted[1].georeference
        edit.commit(replace(topomap, georeference=found), f"georeference {found.source}")
    axis = None if points is not None else direction.axis
    return _create_result(found, posed[0], axis, fitted)


def _fit(
    topomap: TopoMetricMap, gnss: str | Path | None, points: str | Path | None, up: UpDirection
) -> _Fitted:
    if points is not None:
        known = read_control_points(Path(points))
        return known, fit_georeference(known.points_world, known.places, "points")
    known = read_gnss(Path(gnss or ""), topomap)
    return known, fit_georeference(known.points_world, known.places, "gnss", up)


def _create_result(
    found: Georeference, first: Rigid3, up: str | None, fitted: _Fitted | None
) -> GeoreferenceResult:
    heading_deg = found.heading_deg(first.rotation[:, 2])
    if fitted is None:
        return GeoreferenceResult(found, heading_deg, up, [], np.zeros(0), np.zeros(0, dtype=bool))
    known, fit = fitted
    return GeoreferenceResult(found, heading_deg, up, known.names, fit.residuals_m, fit.is_inlier)
