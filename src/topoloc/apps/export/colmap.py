"""COLMAP's sparse model as text, with the rigs and frames of version 3.12.

https://colmap.github.io/format.html
"""

from __future__ import annotations

import re
from collections.abc import Iterable

import numpy as np

from topoloc import Camera, TopolocError
from topoloc.apps.viewer.scene import Scene, View

_HALF_PIXEL = 0.5  # the centre of COLMAP's top-left pixel
_COLUMNS = {
    "cameras": "CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
    "images": "IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME, and a line of POINTS2D[] as"
    " (X, Y, POINT3D_ID)",
    "points3D": "POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)",
    "rigs": "RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, SENSORS[]",
    "frames": "FRAME_ID, RIG_ID, RIG_FROM_WORLD[QW, QX, QY, QZ, TX, TY, TZ], NUM_DATA_IDS,"
    " DATA_IDS[]",
}


def to_colmap_model(scene: Scene) -> dict[str, bytes]:
    """Return the files of a model by their names. Raises TopolocError: a view has no camera."""
    ids, cameras = _find_cameras(scene.views)
    known = {number: camera.to_colmap() for camera, number in cameras.items()}
    rows = {
        "cameras": [
            f"{number} {model} {width} {height} {' '.join(map(repr, params))}"
            for number, (model, width, height, params) in known.items()
        ],
        "points3D": _format_points(scene),
        "rigs": [f"{number} 1 CAMERA {number}" for number in known],
    }
    images, frames = [], []
    for number, view in enumerate(scene.views, 1):
        camera_id, cam_from_world = ids[number - 1], view.world_from_cam.inverse()
        values = (*cam_from_world.quat_wxyz().tolist(), *cam_from_world.translation.tolist())
        pose = " ".join(map(repr, values))
        name = re.sub(r"\s", "_", view.name) or "_"  # COLMAP would cut it at a blank
        points_img = (view.points_img + _HALF_PIXEL).tolist()
        key_points = (
            f"{x:.6f} {y:.6f} {row + 1 if row >= 0 else -1}"
            for (x, y), row in zip(points_img, view.point_rows.tolist(), strict=True)
        )
        images += [f"{number} {pose} {camera_id} {name}", " ".join(key_points)]
        frames.append(f"{number} {camera_id} {pose} 1 CAMERA {camera_id} {number}")
    rows |= {"images": images, "frames": frames}
    return {
        f"{name}.txt": "\n".join([f"# {columns}", *rows[name], ""]).encode()
        for name, columns in _COLUMNS.items()
    }


def _find_cameras(views: Iterable[View]) -> tuple[list[int], dict[Camera, int]]:
    """Return the camera id of each view, from 1, and the ids of the distinct cameras."""
    known: dict[Camera, int] = {}
    ids = []
    for view in views:
        if view.camera is None:
            raise TopolocError(f"{view.name}: a COLMAP model needs its camera, which is not known")
        ids.append(known.setdefault(view.camera, len(known) + 1))
    return ids, known


def _format_points(scene: Scene) -> list[str]:
    tracks: list[list[str]] = [[] for _ in scene.points.world]
    for number, view in enumerate(scene.views, 1):
        for place in np.flatnonzero(view.point_rows >= 0).tolist():
            tracks[view.point_rows[place]].append(f"{number} {place}")
    points = zip(
        scene.points.world.tolist(),
        scene.points.rgb.tolist(),
        scene.points.errors_px.tolist(),
        tracks,
        strict=True,
    )
    return [
        f"{number} {' '.join(map(repr, xyz))} {' '.join(map(str, rgb))} {error:.6f}"
        f" {' '.join(track)}"
        for number, (xyz, rgb, error, track) in enumerate(points, 1)
    ]
