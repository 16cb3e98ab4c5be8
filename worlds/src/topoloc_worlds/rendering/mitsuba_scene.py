"""Convert a world to a Mitsuba scene: one mesh a material, lamps, sky and sun.

Mitsuba is imported inside functions, because the data of a world need no renderer.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float32

from topoloc_worlds.scene import Color, Material, Mesh, Picture, Scene, Sky
from topoloc_worlds.shapes import join

KIND, TINT, ROUGHNESS = "face_kind", "face_tint", "face_roughness"
"""Attributes of every mesh, for `first_hits`: the kind of its material, a metal's mean colour, how
rough it is."""
MATT, POLISHED, METAL, GLASS, LIGHT = range(5)
_KINDS = {"matt": MATT, "polished": POLISHED, "metal": METAL, "glass": GLASS, "light": LIGHT}
_LAMP_PIECE = 4.0
_SMOOTHEST = 0.02  # below it a rough surface is as good as a mirror, and slower


def load_scene(scene: Scene, lamps: list[tuple[Material, Mesh]]) -> Any:
    """Return the scene with its surfaces and lights, without camera and integrator, in Mitsuba's
    current variant.

    Args:
        lamps: light-emitting meshes, in pieces as from `lamp_pieces`. `lamp_name` gives Mitsuba's
            name of each.
    """
    import mitsuba as mi

    parts: dict[str, Any] = {"type": "scene", **lamp_meshes(lamps)}
    dark = [entry for entry in meshes_by_material(scene) if not _shines(entry[0])]
    for index, (material, mesh) in enumerate(dark, start=len(lamps)):
        parts[lamp_name(index)] = _mitsuba_mesh(lamp_name(index), mesh, material)
    if scene.sky is not None:
        parts |= sky_and_sun(scene.sky)
    return mi.load_dict(parts)


def lamp_meshes(lamps: list[tuple[Material, Mesh]]) -> dict[str, Any]:
    """Lamps by the names that `lamp_name` gives them."""
    return {
        lamp_name(index): _mitsuba_mesh(lamp_name(index), mesh, material)
        for index, (material, mesh) in enumerate(lamps)
    }


def meshes_by_material(scene: Scene) -> list[tuple[Material, Mesh]]:
    """All surfaces of one material object as one mesh: few shapes make a fast ray tracer."""
    groups: dict[int, tuple[Material, list[Mesh]]] = {}
    for surface in scene.surfaces:
        groups.setdefault(id(surface.material), (surface.material, []))[1].append(surface.mesh)
    return [(material, join(meshes)) for material, meshes in groups.values()]


def lamp_pieces(scene: Scene) -> list[tuple[Material, Mesh]]:
    """Return all lamps, divided into pieces of a few metres. Otherwise all lamps of a street would
    be one mesh with one sampling weight."""
    lamps = [entry for entry in meshes_by_material(scene) if _shines(entry[0])]
    return [(material, piece) for material, mesh in lamps for piece in pieces(mesh, _LAMP_PIECE)]


def pieces(mesh: Mesh, size: float) -> list[Mesh]:
    """Divide a mesh by a grid of cells of `size` metres. Each face goes to the cell of its centre,
    uncut."""
    cells = np.floor(mesh.vertices[mesh.faces].mean(axis=1) / size).astype(np.int64)
    _, group = np.unique(cells, axis=0, return_inverse=True)
    parts = []
    for index in range(int(group.max()) + 1):
        faces = mesh.faces[group.ravel() == index]
        used, renumbered = np.unique(faces, return_inverse=True)
        parts.append(
            Mesh(mesh.vertices[used], renumbered.reshape(-1, 3).astype(np.int32), mesh.uv[used])
        )
    return parts


def radiance_of(material: Material) -> Float32[np.ndarray, "*shape 3"]:
    """Light that a lamp or screen gives, as its colour is: one value or a picture."""
    return linear_from_srgb(material.color) * np.float32(material.radiance)


def lamp_name(index: int) -> str:
    """Return Mitsuba's name of the mesh of one of `lamp_pieces`."""
    return f"mesh{index:05d}"


def _mitsuba_mesh(name: str, mesh: Mesh, material: Material) -> Any:
    import mitsuba as mi

    properties = mi.Properties()
    properties["face_normals"] = True
    properties["bsdf"] = mi.load_dict(_bsdf(material))
    if _shines(material):
        properties["emitter"] = mi.load_dict(_emitter(material))
    result: Any = mi.Mesh(
        name, len(mesh.vertices), len(mesh.faces), has_vertex_texcoords=True, props=properties
    )
    parameters = mi.traverse(result)
    parameters["vertex_positions"] = np.ascontiguousarray(mesh.vertices, np.float32).ravel()
    parameters["faces"] = np.ascontiguousarray(mesh.faces, np.uint32).ravel()
    parameters["vertex_texcoords"] = np.ascontiguousarray(mesh.uv, np.float32).ravel()
    parameters.update()
    tint = linear_from_srgb(material.color).reshape(-1, 3).mean(axis=0)
    result.add_attribute(KIND, 1, np.full(len(mesh.faces), _KINDS[material.kind], np.float32))
    result.add_attribute(TINT, 3, np.tile(tint, len(mesh.faces)))
    roughness = 0.0 if material.kind == "glass" else material.roughness
    result.add_attribute(ROUGHNESS, 1, np.full(len(mesh.faces), roughness, np.float32))
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
    return {
        "type": "mask",
        "opacity": _bitmap(material.opacity[:, :, None].astype(np.float32) / 255.0),
        "bsdf": both,
    }


def _emitter(material: Material) -> dict[str, Any]:
    linear = radiance_of(material)
    radiance = {"type": "rgb", "value": linear.tolist()} if linear.ndim == 1 else _bitmap(linear)
    return {"type": "area", "radiance": radiance}


def _shines(material: Material) -> bool:
    return material.kind == "light" and material.radiance > 0.0


def sky_and_sun(sky: Sky) -> dict[str, Any]:
    """The lights of the sky, named "sky" and "sun"."""
    import mitsuba as mi

    # Mitsuba's own picture of the sky has y up and starts elsewhere; this turns it so that column 0
    # looks along +x.
    to_world = mi.ScalarTransform4f(
        np.array(
            [
                [0.0, 0.0, -1.0, 0.0],
                [1.0, 0.0, 0.0, 0.0],
                [0.0, 1.0, 0.0, 0.0],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
    )
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

    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(picture)),
        "raw": True,
        "wrap_mode": "repeat",
    }


def linear_from_srgb(color: Picture | Sequence[float]) -> Float32[np.ndarray, "*shape 3"]:
    """Linear light of sRGB values: a picture of bytes, or one colour in [0, 1]."""
    value = np.asarray(color)
    if value.dtype == np.uint8:
        return _TABLE[value]
    return _linear(value.astype(np.float64)).astype(np.float32)


def _linear(value: np.ndarray) -> np.ndarray:
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


_TABLE = _linear(np.arange(256) / 255.0).astype(np.float32)
