"""nerfstudio's ``transforms.json`` with its pictures: OpenGL's camera axes (x right, y up, z back).

https://docs.nerf.studio/quickstart/data_conventions.html
"""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np

from topoloc import Camera, TopolocError
from topoloc.apps.export.text_formats import to_ply
from topoloc.apps.viewer.scene import Scene, View

_CAM_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_POINTS_FILE = "sparse_pc.ply"


def to_nerfstudio(scene: Scene) -> dict[str, bytes]:
    """``transforms.json``, the pictures as a map keeps them (results name theirs), and the points
    that training may begin with.

    Raises:
        TopolocError: a view has no camera.
    """
    files, frames = dict[str, bytes](), []
    for number, view in enumerate(scene.views):
        camera, file_path = view.jpeg_camera or view.camera, view.name
        if camera is None:
            raise TopolocError(f"{view.name}: nerfstudio needs its camera, which is not known")
        if view.jpeg:
            file_path = f"images/{number:06d}_{_frame_to_json(view)}.jpg"
            files[file_path] = view.jpeg
        matrix = view.world_from_cam.matrix() @ _CAM_FROM_OPENGL
        frames.append(
            {
                "file_path": file_path,
                **_intrinsics_to_json(camera),
                "transform_matrix": matrix.tolist(),
            }
        )
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


def _frame_to_json(view: View) -> str:
    return re.sub(r"[^\w.-]", "_", view.name.rpartition("/")[2].rpartition(".")[0] or view.name)[
        :100
    ]


def _intrinsics_to_json(camera: Camera) -> dict[str, Any]:
    """Its pixels begin at the corner of the first one, as COLMAP's do."""
    model, width, height, _ = camera.to_colmap()
    names = (
        ("k1", "k2", "k3", "k4")
        if camera.is_fisheye
        else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    )
    distortion = dict(zip(names, camera.distortion().tolist(), strict=True))
    if any(distortion.get(name, 0.0) for name in ("k5", "k6")) or (
        not camera.is_fisheye and distortion["k4"]
    ):
        raise TopolocError(
            f"nerfstudio does not know the lens {model} with more than three radial coefficients"
        )
    return {
        "camera_model": "OPENCV_FISHEYE" if camera.is_fisheye else "OPENCV",
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + 0.5,
        "cy": camera.cy + 0.5,
        "w": width,
        "h": height,
        **{name: value for name, value in distortion.items() if name not in ("k5", "k6")},
    }
