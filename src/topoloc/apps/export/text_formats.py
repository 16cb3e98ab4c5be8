"""Scenes as one file each: trajectories (TUM, KITTI), points and cameras (PLY), places on earth
(GeoJSON)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import groupby, pairwise
from typing import Any

import numpy as np

from topoloc import GeoreferenceError, Trajectory, TrajectoryError
from topoloc.apps.viewer.scene import Scene, View
from topoloc.plugin import tum_text

_CAMERA_RGB = (255, 0, 0)


def to_tum(scene: Scene) -> bytes:
    """``t tx ty tz qx qy qz qw`` of the views, world_from_cam. Where no view has a time, t is its
    number.

    Raises:
        TrajectoryError: times do not increase, as those of several sessions may not.
    """
    views = scene.views
    if all(view.t_ns is None for view in views):
        times = [number * 1_000_000_000 for number in range(len(views))]
    else:
        views = sorted(
            (view for view in views if view.t_ns is not None), key=lambda view: view.t_ns or 0
        )
        times = [view.t_ns for view in views if view.t_ns is not None]
    if any(after <= before for before, after in pairwise(times)):
        raise TrajectoryError(
            "two poses have one time: TUM files are of one stream (--session N exports one session"
            " of a map)"
        )
    return tum_text(Trajectory([view.world_from_cam for view in views], times)).encode()


def to_kitti(scene: Scene) -> bytes:
    """The upper 3x4 of world_from_cam, a line a pose; of a map all mapping pictures, not its nodes
    alone."""
    rows = (pose.matrix()[:3].ravel().tolist() for pose in scene.trajectory)
    return "".join(" ".join(f"{value:.12g}" for value in row) + "\n" for row in rows).encode()


def to_ply(scene: Scene) -> bytes:
    """Points with their colours, binary little-endian; of results the cameras' positions, in
    red."""
    world, rgb = scene.points.world, scene.points.rgb
    if len(world) == 0:
        world = np.array([pose.translation for pose in scene.trajectory])
        rgb = np.tile(np.array(_CAMERA_RGB, np.uint8), (len(world), 1))
    vertices = np.zeros(len(world), [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    vertices["xyz"], vertices["rgb"] = world, rgb
    properties = [
        *(f"property float {name}" for name in "xyz"),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
    ]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(world)}",
        *properties,
        "end_header",
        "",
    ]
    return "\n".join(header).encode() + vertices.tobytes()


def to_geojson(scene: Scene) -> bytes:
    """RFC 7946: a point for each view, a line for each session's way; longitude, latitude, height
    above the ellipsoid.

    Raises:
        GeoreferenceError: nobody said where on earth that is.
    """
    features = [_view_to_point(view) for view in scene.views if view.geopose is not None]
    if not features:
        raise GeoreferenceError(
            "GeoJSON needs places on earth: `topoloc georeference MAP` says where the map lies"
        )
    lines = []
    for session_id, group in groupby(scene.views, lambda view: view.session_id):
        way = [_coordinates(view) for view in group if view.geopose is not None]
        if len(way) > 1:
            lines.append(geojson_feature("LineString", way, {"session": session_id}))
    return (
        json.dumps({"type": "FeatureCollection", "features": [*lines, *features]}, indent=1) + "\n"
    ).encode()


def _view_to_point(view: View) -> dict[str, Any]:
    properties: dict[str, Any] = {"name": view.name, "t_ns": view.t_ns, "session": view.session_id}
    if view.geopose is not None:
        properties["quaternion"] = view.geopose.to_json()["quaternion"]
    return geojson_feature("Point", _coordinates(view), properties)


def geojson_feature(
    kind: str, coordinates: Sequence[Any], properties: dict[str, Any]
) -> dict[str, Any]:
    """A feature of GeoJSON: longitude, latitude, height."""
    return {
        "type": "Feature",
        "geometry": {"type": kind, "coordinates": coordinates},
        "properties": properties,
    }


def _coordinates(view: View) -> list[float]:
    assert view.geopose is not None
    position = view.geopose.position
    return [round(position.lon, 9), round(position.lat, 9), round(position.h, 4)]
