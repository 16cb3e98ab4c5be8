"""A map file gets its place on earth: from its first image, or fitted to known places."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from topoloc import GeoPoint, Georeference, GeoreferenceError, TopoMetricMap
from topoloc.apps.core_names import OneLine, edit_map, parse_times, read_rows
from topoloc.apps.georeferencing.georeference_fit import (
    GeoreferenceFit,
    estimate_up_direction,
    fit_georeference,
    georeference_from_heading,
)

_MAX_GAP_NS = 2_000_000_000
"""Positions are not interpolated between fixes further apart in time."""


@dataclass(frozen=True, eq=False)
class ControlPoints:
    """Hold points of the world (metres), their places on earth and their names for display."""

    points_world: Float[np.ndarray, "n 3"]
    places: Sequence[GeoPoint]
    names: Sequence[str]

    @staticmethod
    def from_rows(
        rows: Sequence[tuple[Sequence[float] | np.ndarray, GeoPoint, str]],
    ) -> ControlPoints:
        """Return the points of rows of point, place and name."""
        points, places, names = zip(*rows, strict=True)
        return ControlPoints(np.array(points), places, names)


def read_control_points(path: Path) -> ControlPoints:
    """Read lines of ``x, y, z, lat, lon, h``: metres of the map's world, degrees, metres above the
    ellipsoid. A header line is optional.

    Raises:
        GeoreferenceError: the file is missing or empty, columns or numbers are missing, or a place
            is not on earth. Names the line.
    """
    found = []
    for line, columns in _read_table(path, 6, 0, "x, y, z, lat, lon, h"):
        point = _parse_numbers(path, line, columns[:3])
        found.append((point, _parse_geo_point(path, line, columns[3:6]), f"line {line}"))
    return ControlPoints.from_rows(found)


def read_gnss(path: Path, topomap: TopoMetricMap) -> ControlPoints:
    """Read lines of ``name, lat, lon, h`` or ``time, lat, lon, h``: the places of mapping images by
    name, or of the camera by time. Times are in the recordings' clock, in seconds, or in
    nanoseconds if they are large. Places between two fixes are interpolated.

    Raises GeoreferenceError if the file is missing or empty, columns or numbers are missing, a
    place is not on earth, or no line matches the map. It names the line.
    """
    rows = _read_table(path, 4, 1, "time or name, lat, lon, h")
    places = [_parse_geo_point(path, line, columns[1:4]) for line, columns in rows]
    positions = _find_positions_by_name(topomap)
    named = [
        (positions[columns[0]], place, columns[0])
        for (_, columns), place in zip(rows, places, strict=True)
        if columns[0] in positions
    ]
    if named:
        return ControlPoints.from_rows(named)
    if not all(_is_number(columns[0]) for _, columns in rows):
        example = next(iter(positions), "none")
        raise GeoreferenceError(
            f"{path}: no line begins with a time, or the name of a mapping picture, such as"
            f" {example}"
        )
    return _interpolate_at_times(
        path, topomap, parse_times(rows, path, GeoreferenceError, np.inf), places
    )


def _interpolate_at_times(
    path: Path, topomap: TopoMetricMap, t_ns: Sequence[int], places: Sequence[GeoPoint]
) -> ControlPoints:
    """Interpolate the places of the nodes at their times."""
    origin = places[0].ecef_from_enu()
    points_enu = np.array([origin.inverse().apply(place.ecef()) for place in places])
    found: list[tuple[np.ndarray, GeoPoint, str]] = []
    for summary in topomap.summaries:
        after = int(np.searchsorted(t_ns, summary.t_ns))
        if after < len(t_ns) and t_ns[after] == summary.t_ns:
            point_enu = points_enu[after]
        elif 0 < after < len(t_ns) and t_ns[after] - t_ns[after - 1] <= _MAX_GAP_NS:
            share = (summary.t_ns - t_ns[after - 1]) / (t_ns[after] - t_ns[after - 1])
            point_enu = (1.0 - share) * points_enu[after - 1] + share * points_enu[after]
        else:
            continue
        place = GeoPoint.from_ecef(origin.apply(point_enu))
        found.append((summary.world_from_cam.translation, place, summary.name))
    if not found:
        times = [summary.t_ns for summary in topomap.summaries]
        spans = " and ".join(
            f"{min(span) / 1e9:.3f} to {max(span) / 1e9:.3f} s" for span in (t_ns, times)
        )
        raise GeoreferenceError(f"{path}: no fix is of a time of the map ({spans})")
    return ControlPoints.from_rows(found)


def _find_positions_by_name(topomap: TopoMetricMap) -> dict[str, Float[np.ndarray, "3"]]:
    """Return the positions of mapping images by full name, file name, and name with the recording.
    Ambiguous names are left out."""
    positions, twice = dict[str, np.ndarray](), set[str]()
    for image in (*topomap.place_images, *topomap.summaries):
        for name in {image.name, Path(image.name).name, f"{image.recording}/{image.name}"}:
            position = image.world_from_cam.translation
            if name in positions and not np.allclose(positions[name], position, atol=0.05):
                twice.add(name)
            positions[name] = position
    return {name: position for name, position in positions.items() if name not in twice}


def _read_table(
    path: Path, num_columns: int, first_numeric_column: int, wanted: str
) -> list[tuple[int, list[str]]]:
    """Return line numbers and columns, without a header line."""
    if path.exists() and not path.is_file():
        raise GeoreferenceError(f"{path}: no file")
    rows = read_rows(path, GeoreferenceError)
    if not all(_is_number(text) for text in rows[0][1][first_numeric_column:num_columns]):
        rows = rows[1:]
    for line, columns in rows:
        if len(columns) < num_columns:
            raise GeoreferenceError(
                f"{path}, line {line}: {len(columns)} columns; {wanted} are needed"
            )
    if not rows:
        raise GeoreferenceError(f"{path}: nothing in this file but titles")
    return rows


def _parse_numbers(path: Path, line: int, columns: Sequence[str]) -> list[float]:
    for text in columns:
        if not _is_number(text):
            raise GeoreferenceError(f"{path}, line {line}: {text[:40]!r} is not a number")
    return [float(text) for text in columns]


def _is_number(text: str) -> bool:
    try:
        number = Decimal(text)
    except InvalidOperation:
        return False
    return number.is_finite() and abs(number.adjusted()) < 300


def _parse_geo_point(path: Path, line: int, columns: Sequence[str]) -> GeoPoint:
    values = _parse_numbers(path, line, columns)
    with GeoreferenceError.at(f"{path}, line {line}"):
        return GeoPoint(*values)


@dataclass(frozen=True, eq=False, repr=False)
class GeoreferenceResult(OneLine):
    """The georeference of a map, the heading of its first image (degrees clockwise from true
    north), and the axis of the world that is up (None if points determined it).

    A fit also has the names of the points, their residuals (m), and whether the fit used them.
    """

    georeference: Georeference
    heading_deg: float
    up: str | None
    names: Sequence[str]
    residuals_m: Float[np.ndarray, " n"]
    is_inlier: Bool[np.ndarray, " n"]


def georeference(
    path: str | Path,
    origin: tuple[GeoPoint, float] | None = None,
    gnss: str | Path | None = None,
    points: str | Path | None = None,
    up: str | None = None,
    on_wait: Callable[[], None] | None = None,
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
        topomap.require_scale("a place on earth")
        posed = [image.world_from_cam for image in topomap.place_images] or [
            summary.world_from_cam for summary in topomap.summaries
        ]
        if not posed:
            raise GeoreferenceError(f"map {path} has no mapping picture")
        direction, names = estimate_up_direction(posed, up), ()
        if origin is not None:
            placed = georeference_from_heading(posed[0], *origin, direction)
            fit = GeoreferenceFit(placed, np.zeros(0), np.zeros(0, dtype=bool))
        else:
            if points is not None:
                known, source, direction = read_control_points(Path(points)), "points", None
            else:
                known, source = read_gnss(Path(gnss or ""), topomap), "gnss"
            names = known.names
            fit = fit_georeference(known.points_world, known.places, source, direction)
        found = fit.georeference
        edit.commit(replace(topomap, georeference=found), f"georeference {found.source}")
    heading_deg = found.heading_deg(posed[0].rotation[:, 2])
    axis = None if direction is None else direction.axis
    return GeoreferenceResult(found, heading_deg, axis, names, fit.residuals_m, fit.is_inlier)
