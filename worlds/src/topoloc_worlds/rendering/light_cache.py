"""Light found once for a world and a condition serves all recordings there: it is kept among the
user's cache files."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float64

from topoloc_worlds.rendering.light_bake import LightBakeConfig
from topoloc_worlds.rendering.light_cells import CellGrid, LightCells, light_cells
from topoloc_worlds.rendering.variant import cache_folder
from topoloc_worlds.scene import Scene

_FORMAT = 3
_MAX_FILES = 24


def cached_light(
    scene: Scene,
    viewpoints: Float64[np.ndarray, "n 3"],
    config: LightBakeConfig,
    grid: CellGrid,
    bake: Callable[[], LightCells],
) -> LightCells:
    """The light of a scene from the cache, else from `bake`, then kept. Without a writable cache it
    is traced every time."""
    try:
        file = cache_folder() / "light" / f"{_digest(scene, viewpoints, config)}.npz"
    except RuntimeError:  # the user has no home
        return bake()
    try:
        with np.load(file) as arrays:
            return light_cells(grid, arrays["keys"], arrays["light"])
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        pass  # not there, or broken: traced anew
    cells = bake()
    _keep(file, cells)
    return cells


def _keep(file: Path, cells: LightCells) -> None:
    part = file.with_name(f".{file.name}.{os.getpid()}.part")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with part.open("wb") as stream:
            np.savez(stream, keys=cells.keys, light=cells.light)
        os.replace(part, file)
        for old in sorted(file.parent.glob("*.npz"), key=lambda path: path.stat().st_mtime)[
            :-_MAX_FILES
        ]:
            old.unlink()
    except OSError:  # it is only a shortcut
        with suppress(OSError):
            part.unlink(missing_ok=True)


def _digest(scene: Scene, viewpoints: Float64[np.ndarray, "n 3"], config: LightBakeConfig) -> str:
    """Of all that the light depends on."""
    digest = hashlib.sha256(
        repr((_FORMAT, version("mitsuba"), asdict(config), viewpoints.shape)).encode()
    )
    digest.update(np.ascontiguousarray(viewpoints).tobytes())
    if scene.sky is not None:
        digest.update(np.ascontiguousarray(scene.sky.radiance).tobytes())
        digest.update(repr((scene.sky.sun_irradiance, scene.sky.sun_direction)).encode())
    pictures: dict[int, str] = {}
    for surface in scene.surfaces:
        for array in (surface.mesh.vertices, surface.mesh.faces, surface.mesh.uv):
            digest.update(np.ascontiguousarray(array).tobytes())
        material = surface.material
        digest.update(repr((material.kind, material.roughness, material.radiance)).encode())
        for picture in (material.color, material.opacity):
            if isinstance(picture, np.ndarray):
                if id(picture) not in pictures:
                    pictures[id(picture)] = hashlib.sha256(
                        np.ascontiguousarray(picture).tobytes()
                    ).hexdigest()
                digest.update(pictures[id(picture)].encode())
            else:
                digest.update(repr(picture).encode())
    return digest.hexdigest()[:32]
