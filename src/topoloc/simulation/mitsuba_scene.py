"""A world as Mitsuba wants it: one mesh a material, lamps, sky and sun.

Mitsuba is imported where it is used: the data of a world need no renderer.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float32

from topoloc.simulation.scene import Color, Material, Mesh, Picture, Scene, Sky
from topoloc.simulation.shapes import join

_SMOOTHEST = 0.02  # below it a rough surface is as good as a mirror, and slower


def load_scene(scene: Scene) -> Any:
    """The scene with its surfaces and lights, without camera and integrator, in Mitsuba's current variant."""
    import mitsuba as mi

    parts: dict[str, Any] = {"type": "scene"}
    for index, (material, mesh) in enumerate(meshes_by_material(scene)):
        parts[f"mesh{index:04d}"] = _mitsuba_mesh(f"mesh{index:04d}", mesh, material)
    if scene.sky is not None:
        parts |= _sky(scene.sky)
    elif not any(surface.material.kind == "light" for surface in scene.surfaces):
        parts["dark"] = {"type": "constant", "radiance": 0.0}
    return mi.load_dict(parts)


def meshes_by_material(scene: Scene) -> list[tuple[Material, Mesh]]:
    """All surfaces of one material object as one mesh: few shapes make a fast ray tracer."""
    groups: dict[int, tuple[Material, list[Mesh]]] = {}
    for surface in scene.surfaces:
        groups.setdefault(id(surface.material), (surface.material, []))[1].append(surface.mesh)
    return [(material, join(meshes)) for material, meshes in groups.values()]


def _mitsuba_mesh(name: str, mesh: Mesh, material: Material) -> Any:
    import mitsuba as mi

    properties = mi.Properties()
    properties["face_normals"] = True
    properties["bsdf"] = mi.load_dict(_bsdf(material))
    if material.kind == "light":
        properties["emitter"] = mi.load_dict(_emitter(material, mesh))
    result = mi.Mesh(name, len(mesh.vertices), len(mesh.faces), has_vertex_texcoords=True, props=properties)
    parameters = mi.traverse(result)
    parameters["vertex_positions"] = np.ascontiguousarray(mesh.vertices, np.float32).ravel()
    parameters["faces"] = np.ascontiguousarray(mesh.faces, np.uint32).ravel()
    parameters["vertex_texcoords"] = np.ascontiguousarray(mesh.uv, np.float32).ravel()
    parameters.update()
    return result


def _bsdf(material: Material) -> dict[str, Any]:
    if material.kind == "light":
        plain: dict[str, Any] = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    elif material.kind == "glass":
        plain = {"type": "thindielectric"}
    elif material.kind == "metal":
        plain = {"type": "roughconductor", "alpha": material.roughness, "distribution": "ggx"}
        if material.roughness < _SMOOTHEST:
            plain = {"type": "conductor"}
        plain |= {"material": "none", "specular_reflectance": _texture(material.color)}
    elif material.kind == "polished":
        plain = {"type": "roughplastic", "alpha": material.roughness, "distribution": "ggx"}
        if material.roughness < _SMOOTHEST:
            plain = {"type": "plastic"}
        plain |= {"diffuse_reflectance": _texture(material.color)}
    else:
        plain = {"type": "diffuse", "reflectance": _texture(material.color)}
    both = plain if material.kind == "glass" else {"type": "twosided", "bsdf": plain}
    if material.opacity is None:
        return both
    return {"type": "mask", "opacity": _bitmap(material.opacity[:, :, None].astype(np.float32) / 255.0), "bsdf": both}


def _emitter(material: Material, mesh: Mesh) -> dict[str, Any]:
    linear = linear_from_srgb(material.color) * np.float32(material.radiance)
    radiance = {"type": "rgb", "value": linear.tolist()} if linear.ndim == 1 else _bitmap(linear)
    corners = mesh.vertices[mesh.faces]
    area = 0.5 * float(np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum())
    power = area * float(linear.mean())
    return {"type": "area", "radiance": radiance, "sampling_weight": max(power, 1e-6)}


def _sky(sky: Sky) -> dict[str, Any]:
    import mitsuba as mi

    # Mitsuba's own picture of the sky has y up and starts elsewhere; this turns it so that column 0 looks along +x.
    to_world = mi.ScalarTransform4f(np.array([[0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]))
    picture = mi.Bitmap(np.ascontiguousarray(sky.radiance, np.float32))
    parts: dict[str, Any] = {"sky": {"type": "envmap", "bitmap": picture, "to_world": to_world}}
    if sky.sun_direction is not None:
        direction = (-np.asarray(sky.sun_direction)).tolist()
        irradiance = {"type": "rgb", "value": list(sky.sun_irradiance)}
        parts["sun"] = {"type": "directional", "direction": direction, "irradiance": irradiance}
    return parts


def _texture(color: Picture | Color) -> dict[str, Any]:
    linear = linear_from_srgb(color)
    return {"type": "rgb", "value": linear.tolist()} if linear.ndim == 1 else _bitmap(linear)


def _bitmap(picture: Float32[np.ndarray, "h w c"]) -> dict[str, Any]:
    import mitsuba as mi

    return {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(picture)), "raw": True, "wrap_mode": "repeat"}


def linear_from_srgb(color: Picture | Sequence[float]) -> Float32[np.ndarray, "*shape 3"]:
    """Linear light of sRGB values: a picture of bytes, or one colour in [0, 1]."""
    value = np.asarray(color)
    if value.dtype == np.uint8:
        return _TABLE[value]
    return _linear(value.astype(np.float64)).astype(np.float32)


def _linear(value: np.ndarray) -> np.ndarray:
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


_TABLE = _linear(np.arange(256) / 255.0).astype(np.float32)
