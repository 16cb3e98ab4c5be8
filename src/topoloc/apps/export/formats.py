"""Export of maps and results to other programs: all formats, and those of one file.

COLMAP and MCAP are in `colmap.py` and `foxglove.py`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from topoloc import (
    Camera,
    GeoPoint,
    GeoreferenceError,
    TopolocError,
    TopoMetricMap,
    Trajectory,
    TrajectoryError,
)
from topoloc.apps.export.colmap import to_colmap_model
from topoloc.apps.export.foxglove import to_mcap
from topoloc.apps.viewer.map_scene import create_map_scene
from topoloc.apps.viewer.scene import Scene, image_type
from topoloc.plugin import write_bytes, write_folder

_CAMERA_RGB = (255, 0, 0)
_CAM_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_POINTS_FILE = "sparse_pc.ply"
_MAX_FLOAT_M = 1000.0  # where 32 bits have steps of 0.06 mm


def export(path: str | Path, out: str | Path, format: str | None = None) -> None:
    """Write a map file in a format of another program, at once or not at all.

    Args:
        path: the map file.
        out: the file to write, or for COLMAP and nerfstudio the folder.
        format: colmap, nerfstudio, ply, geojson, mcap, tum or kitti; by default from the suffix of
            `out`, and COLMAP for a folder.

    Raises:
        TopolocError: the format is unknown, the map lacks what it needs, or `out` cannot be
            written.
        MapError: the map cannot be read.
    """
    form = find_export_format(Path(out), format)
    with TopoMetricMap.load(path) as topomap:
        scene = create_map_scene(topomap, Path(path).stem, None, form.with_points)
        write_scene(scene, Path(out), form)


def to_tum(scene: Scene) -> bytes:
    """Return ``t tx ty tz qx qy qz qw`` of the views, world_from_cam. If no view has a time, t is
    its number. Raises TrajectoryError: times do not increase, for example in several sessions."""
    timed = [(view.t_ns, view.world_from_cam) for view in scene.views if view.t_ns is not None]
    timed.sort(key=lambda pair: pair[0])
    if not timed:
        timed = [(k * 1_000_000_000, view.world_from_cam) for k, view in enumerate(scene.views)]
    times = [t_ns for t_ns, _ in timed]
    if any(after <= before for before, after in pairwise(times)):
        raise TrajectoryError(
            "two poses have the same time: a TUM file holds one stream (--session N exports one"
            " session of a map)"
        )
    return Trajectory([pose for _, pose in timed], times).to_tum().encode()


def to_kitti(scene: Scene) -> bytes:
    """Return the upper 3x4 of world_from_cam, one line for each pose of the trajectory."""
    rows = (pose.matrix()[:3].ravel().tolist() for pose in scene.trajectory)
    return "".join(" ".join(f"{value:.12g}" for value in row) + "\n" for row in rows).encode()


def to_ply(scene: Scene) -> bytes:
    """Return the points with their colours, binary little-endian. Without points, return the
    positions of the trajectory in red. Coordinates of the earth (UTM, ECEF) need doubles."""
    world, rgb = scene.points.world, scene.points.rgb
    if len(world) == 0:
        world = np.array([pose.translation for pose in scene.trajectory])
        rgb = np.tile(np.array(_CAMERA_RGB, np.uint8), (len(world), 1))
    is_far = np.abs(world).max(initial=0.0) > _MAX_FLOAT_M
    vertices = np.zeros(len(world), [("xyz", "<f8" if is_far else "<f4", 3), ("rgb", "u1", 3)])
    vertices["xyz"], vertices["rgb"] = world, rgb
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(world)}",
        *(f"property {'double' if is_far else 'float'} {name}" for name in "xyz"),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        "end_header",
        "",
    ]
    return "\n".join(header).encode() + vertices.tobytes()


def to_geojson(scene: Scene) -> bytes:
    """Return RFC 7946: a point for each view and junction, a line for each session. Coordinates
    are longitude, latitude and height above the ellipsoid. Raises GeoreferenceError: the scene is
    not georeferenced."""
    points, lines = [], []
    for session_id, group in groupby(scene.views, lambda view: view.session_id):
        line = []
        for view in group:
            if view.geopose is not None:
                line.append(coordinates(view.geopose.position))
                facts = {"name": view.name, "t_ns": view.t_ns, "session": session_id}
                facts["quaternion"] = view.geopose.to_json()["quaternion"]
                points.append(geojson_feature("Point", line[-1], facts))
        if len(line) > 1:
            lines.append(geojson_feature("LineString", line, {"session": session_id}))
    if not points:
        raise GeoreferenceError(
            "GeoJSON needs a georeferenced map; `topoloc georeference MAP` sets the position"
        )
    if scene.georeference is not None:
        for one in scene.junctions:
            at = scene.georeference.geopoint(np.array(one["position"]))
            points.append(geojson_feature("Point", coordinates(at), {"junction": True, **one}))
    collection = {"type": "FeatureCollection", "features": [*lines, *points]}
    return (json.dumps(collection, indent=1) + "\n").encode()


def geojson_feature(
    kind: str, coordinates: Sequence[Any], properties: dict[str, Any]
) -> dict[str, Any]:
    """Return a feature of GeoJSON."""
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def coordinates(position: GeoPoint) -> list[float]:
    """Return longitude, latitude (degrees) and height (metres) for GeoJSON."""
    return [round(position.lon, 9), round(position.lat, 9), round(position.h, 4)]


def to_nerfstudio(scene: Scene) -> dict[str, bytes]:
    """Return nerfstudio's ``transforms.json``, the images of a map, and the points for training.

    Camera axes are those of OpenGL: x right, y up, z back. Results refer to their own images.
    Raises TopolocError: a view has no camera, or the cameras are of several models.
    https://docs.nerf.studio/quickstart/data_conventions.html
    """
    files, frames = dict[str, bytes](), []
    for number, view in enumerate(scene.views):
        camera, file_path = view.image_camera or view.camera, view.name
        if camera is None:
            raise TopolocError(f"{view.name}: nerfstudio needs the camera, which is not known")
        if view.image:
            suffix = image_type(view.image).replace("jpeg", "jpg")
            stem = view.name.rpartition("/")[2].rpartition(".")[0] or view.name
            stem = re.sub(r"[^\w.-]", "_", stem)[:100]
            file_path = f"images/{number:06d}_{stem}.{suffix}"
            files[file_path] = view.image
        matrix = view.world_from_cam.matrix() @ _CAM_FROM_OPENGL
        frame = {"file_path": file_path, **_intrinsics_to_json(camera)}
        frames.append(frame | {"transform_matrix": matrix.tolist()})
    models = {frame.pop("camera_model") for frame in frames}
    if len(models) > 1:
        raise TopolocError(
            f"nerfstudio takes one camera model, not {' and '.join(sorted(models))}; --session N"
            " exports one session"
        )
    transforms: dict[str, Any] = {"camera_model": models.pop(), "frames": frames}
    if len(scene.points.world):
        transforms["ply_file_path"] = _POINTS_FILE
        files[_POINTS_FILE] = to_ply(scene)
    return {"transforms.json": (json.dumps(transforms, indent=1) + "\n").encode(), **files}


def _intrinsics_to_json(camera: Camera) -> dict[str, Any]:
    """Return the intrinsics. As in COLMAP, the centre of the top-left pixel is (0.5, 0.5)."""
    model, width, height, _ = camera.to_colmap()
    names = ("k1", "k2", "k3", "k4") if camera.is_fisheye else ("k1", "k2", "p1", "p2", "k3", "k4")
    values = camera.distortion().tolist()
    if any(values[len(names) :]) or (not camera.is_fisheye and values[5]):
        raise TopolocError(
            f"nerfstudio does not know the model {model} with more than three radial coefficients"
        )
    return {
        "camera_model": "OPENCV_FISHEYE" if camera.is_fisheye else "OPENCV",
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + 0.5,
        "cy": camera.cy + 0.5,
        "w": width,
        "h": height,
        **dict(zip(names, values, strict=False)),
    }


@dataclass(frozen=True)
class ExportFormat:
    """A format of one file or of a folder. `with_points`: it contains the points of a map."""

    file: Callable[[Scene], bytes] | None = None
    folder: Callable[[Scene], Mapping[str, bytes]] | None = None
    with_points: bool = True


FORMATS = {
    "colmap": ExportFormat(folder=to_colmap_model),
    "nerfstudio": ExportFormat(folder=to_nerfstudio),
    "ply": ExportFormat(to_ply),
    "geojson": ExportFormat(to_geojson, with_points=False),
    "mcap": ExportFormat(to_mcap),
    "tum": ExportFormat(to_tum, with_points=False),
    "kitti": ExportFormat(to_kitti, with_points=False),
}


def find_export_format(out: Path, named: str | None = None) -> ExportFormat:
    """Return the named format, else the one of the suffix of `out`. A folder is a COLMAP model.
    Raises TopolocError: the format or the suffix is unknown."""
    name = named or out.suffix.lower().removeprefix(".") or "colmap"
    if named is None and out.is_dir():
        name = "colmap"
    if name not in FORMATS:
        raise TopolocError(f"{named or out}: unknown format; --format takes {', '.join(FORMATS)}")
    return FORMATS[name]


def write_scene(scene: Scene, out: Path, form: ExportFormat) -> None:
    """Write the file or the folder atomically. Raises TopolocError: it cannot be written, or the
    scene lacks data of the format."""
    if form.file is not None:
        write_bytes(out, form.file(scene))
    elif form.folder is not None:
        write_folder(out, form.folder(scene))
