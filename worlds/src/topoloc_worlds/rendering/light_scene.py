"""A world as light sees it: one mesh of plain colours, so that paths through it are traced several
times as fast.

Pictures on surfaces become one colour a face, coats and metal send their light to all sides, panes
let it through, and of a crown's leaf cards as many are left as their leaves cover of them.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from topoloc_worlds.rendering.mitsuba_scene import (
    lamp_meshes,
    linear_from_srgb,
    meshes_by_material,
    sky_and_sun,
)
from topoloc_worlds.scene import Material, Mesh, Scene
from topoloc_worlds.shapes import join

_COLOR = "face_color"
_REDUCED_PX = 32
_INSIDE = np.array([[1 / 3, 1 / 3, 1 / 3], [0.7, 0.15, 0.15], [0.15, 0.7, 0.15], [0.15, 0.15, 0.7]])
"""Points within a face at which its picture is looked at."""
_SENT_BACK = {"polished": 0.04, "metal": 0.0}


def load_light_scene(scene: Scene, lamps: list[tuple[Material, Mesh]]) -> Any:
    """The scene in Mitsuba's current variant; `lamps` as in `mitsuba_scene.load_scene`, with the
    same names."""
    import mitsuba as mi

    parts: dict[str, Any] = {"type": "scene", **lamp_meshes(lamps)}
    dark = [
        (material, mesh)
        for material, mesh in meshes_by_material(scene)
        if material.kind not in ("glass", "light")
    ]
    if dark:
        kept = [_kept(material, mesh, number) for number, (material, mesh) in enumerate(dark)]
        colors = np.concatenate(
            [_colors(material, mesh) for (material, _), mesh in zip(dark, kept, strict=True)]
        )
        parts["surfaces"] = _one_mesh(join(kept), colors)
    if scene.sky is not None:
        parts |= sky_and_sun(scene.sky)
    return mi.load_dict(parts)


def _kept(material: Material, mesh: Mesh, number: int) -> Mesh:
    """The faces that light meets."""
    if material.opacity is None:
        return mesh
    there: Bool[np.ndarray, " m"] = (
        np.random.default_rng(number).random(len(mesh.faces)) < material.opacity.mean() / 255.0
    )
    return Mesh(mesh.vertices, mesh.faces[there], mesh.uv)


def _colors(material: Material, mesh: Mesh) -> Float32[np.ndarray, "m 3"]:
    """The linear colour of each face."""
    linear = linear_from_srgb(material.color)
    if linear.ndim == 1:
        colors = np.tile(linear, (len(mesh.faces), 1))
    else:
        size = (min(linear.shape[1], _REDUCED_PX), min(linear.shape[0], _REDUCED_PX))
        reduced = cv2.resize(linear, size, interpolation=cv2.INTER_AREA)
        uv = np.einsum("kc,mcd->mkd", _INSIDE, mesh.uv[mesh.faces]) % 1.0
        columns, rows = (
            np.minimum((uv[:, :, axis] * size[axis]).astype(int), size[axis] - 1) for axis in (0, 1)
        )
        colors = reduced[rows, columns].mean(axis=1)
    return np.minimum(colors + _SENT_BACK.get(material.kind, 0.0), 0.9).astype(np.float32)


def _one_mesh(mesh: Mesh, colors: Float32[np.ndarray, "m 3"]) -> Any:
    import mitsuba as mi

    properties = mi.Properties()
    properties["face_normals"] = True
    plain = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": _COLOR}}
    properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": plain})
    result = mi.Mesh("surfaces", len(mesh.vertices), len(mesh.faces), props=properties)
    result.add_attribute(_COLOR, 3, np.ascontiguousarray(colors).ravel())  # pyright: ignore[reportArgumentType]
    parameters = mi.traverse(result)
    parameters["vertex_positions"] = np.ascontiguousarray(mesh.vertices, np.float32).ravel()
    parameters["faces"] = np.ascontiguousarray(mesh.faces, np.uint32).ravel()
    parameters.update()
    return result
