"""COLMAP's sparse model as text and in its binary form, with the rigs and frames of version 3.12.

https://colmap.github.io/format.html
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from struct import pack

import numpy as np
from jaxtyping import Float, Int

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
_MODEL_IDS = {
    "SIMPLE_PINHOLE": 0,
    "PINHOLE": 1,
    "SIMPLE_RADIAL": 2,
    "RADIAL": 3,
    "OPENCV": 4,
    "OPENCV_FISHEYE": 5,
    "FULL_OPENCV": 6,
}
_CAMERA_SENSOR = 0  # its type in the binary form


@dataclass(frozen=True, eq=False)
class _Image:
    """Hold an image: its pose as qw, qx, qy, qz, tx, ty, tz, the pixels of its key points in
    COLMAP's convention, and the id of the point of each, -1 for none."""

    number: int
    cam_from_world: list[float]
    camera_id: int
    name: str
    points_img: Float[np.ndarray, "n 2"]
    point_ids: Int[np.ndarray, " n"]


def to_colmap_model(scene: Scene) -> dict[str, bytes]:
    """Return the files of a model by their names. Raises TopolocError: a view has no camera."""
    ids, cameras = _find_cameras(scene.views)
    images = list(map(_image, range(1, len(scene.views) + 1), scene.views, ids))
    tracks: list[list[tuple[int, int]]] = [[] for _ in scene.points.world]
    for image in images:
        for place in np.flatnonzero(image.point_ids > 0).tolist():
            tracks[image.point_ids[place] - 1].append((image.number, place))
    rows = {
        "cameras": list(_format_cameras(cameras)),
        "images": [line for image in images for line in _format_image(image)],
        "points3D": list(_format_points(scene, tracks)),
        "rigs": [f"{number} 1 CAMERA {number}" for number in cameras],
        "frames": [
            f"{one.number} {one.camera_id} {' '.join(map(repr, one.cam_from_world))} 1 CAMERA"
            f" {one.camera_id} {one.number}"
            for one in images
        ],
    }
    packed = {
        "cameras": [_pack_camera(number, camera) for number, camera in cameras.items()],
        "images": list(map(_pack_image, images)),
        "points3D": list(_pack_points(scene, tracks)),
        "rigs": [pack("<IIiI", number, 1, _CAMERA_SENSOR, number) for number in cameras],
        "frames": [
            pack("<II7dI", one.number, one.camera_id, *one.cam_from_world, 1)
            + pack("<iIQ", _CAMERA_SENSOR, one.camera_id, one.number)
            for one in images
        ],
    }
    texts = {
        f"{name}.txt": "\n".join([f"# {columns}", *rows[name], ""]).encode()
        for name, columns in _COLUMNS.items()
    }
    return texts | {
        f"{name}.bin": pack("<Q", len(parts)) + b"".join(parts) for name, parts in packed.items()
    }


def _find_cameras(views: Iterable[View]) -> tuple[list[int], dict[int, Camera]]:
    """Return the camera id of each view, from 1, and the distinct cameras by id."""
    known: dict[Camera, int] = {}
    ids = []
    for view in views:
        if view.camera is None:
            raise TopolocError(f"{view.name}: a COLMAP model needs its camera, which is not known")
        ids.append(known.setdefault(view.camera, len(known) + 1))
    return ids, {number: camera for camera, number in known.items()}


def _image(number: int, view: View, camera_id: int) -> _Image:
    cam_from_world = view.world_from_cam.inverse()
    pose = [*cam_from_world.quat_wxyz().tolist(), *cam_from_world.translation.tolist()]
    name = re.sub(r"\s", "_", view.name) or "_"  # COLMAP would cut it at a blank
    point_ids = np.where(view.point_rows >= 0, view.point_rows + 1, -1)
    return _Image(number, pose, camera_id, name, view.points_img + _HALF_PIXEL, point_ids)


def _format_cameras(cameras: dict[int, Camera]) -> Iterator[str]:
    for number, camera in cameras.items():
        model, width, height, params = camera.to_colmap()
        yield f"{number} {model} {width} {height} {' '.join(map(repr, params))}"


def _format_image(image: _Image) -> tuple[str, str]:
    pose = " ".join(map(repr, image.cam_from_world))
    points = zip(image.points_img.tolist(), image.point_ids.tolist(), strict=True)
    key_points = (f"{x:.6f} {y:.6f} {point_id}" for (x, y), point_id in points)
    return f"{image.number} {pose} {image.camera_id} {image.name}", " ".join(key_points)


Point = tuple[int, list[float], list[int], float, list[tuple[int, int]]]


def _points(scene: Scene, tracks: list[list[tuple[int, int]]]) -> Iterator[Point]:
    """Generate the id, position, colour, error (pixels) and track of each point."""
    points = scene.points
    facts = points.world.tolist(), points.rgb.tolist(), points.errors_px.tolist(), tracks
    yield from zip(range(1, len(tracks) + 1), *facts, strict=True)


def _format_points(scene: Scene, tracks: list[list[tuple[int, int]]]) -> Iterator[str]:
    for number, xyz, rgb, error, track in _points(scene, tracks):
        places = " ".join(f"{image} {place}" for image, place in track)
        colour = " ".join(map(str, rgb))
        yield f"{number} {' '.join(map(repr, xyz))} {colour} {error:.6f} {places}"


def _pack_camera(number: int, camera: Camera) -> bytes:
    model, width, height, params = camera.to_colmap()
    head = pack("<IiQQ", number, _MODEL_IDS[model], width, height)
    return head + pack(f"<{len(params)}d", *params)


def _pack_image(image: _Image) -> bytes:
    head = pack("<I7dI", image.number, *image.cam_from_world, image.camera_id)
    points = np.empty(len(image.point_ids), [("at", "<f8", 2), ("point", "<i8")])
    points["at"], points["point"] = image.points_img, image.point_ids
    return head + image.name.encode() + b"\0" + pack("<Q", len(points)) + points.tobytes()


def _pack_points(scene: Scene, tracks: list[list[tuple[int, int]]]) -> Iterator[bytes]:
    for number, xyz, rgb, error, track in _points(scene, tracks):
        head = pack("<Q3d3BdQ", number, *xyz, *rgb, error, len(track))
        yield head + np.array(track, "<u4").tobytes()
