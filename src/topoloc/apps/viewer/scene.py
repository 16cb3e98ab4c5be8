"""Data of a scene to show or export: images with known poses, and the points that they show."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from topoloc import Camera, GeoPose, Georeference, Rigid3

Progress = Callable[[str, int, int], None]
"""Called with a stage's name, steps done and steps in all."""


@dataclass(frozen=True, eq=False)
class View:
    """An image with its pose. `name` is its file name. `t_ns` is None without a time.

    Pixel `points_img[k]` of `camera` shows point `point_rows[k]` of the scene, -1 for none. `image`
    is the encoded image (WebP or JPEG) of `image_camera`, which may be smaller than `camera`. It is
    empty without an image.
    """

    name: str
    world_from_cam: Rigid3
    t_ns: int | None = None
    camera: Camera | None = None
    session_id: int = 0
    points_img: Float[np.ndarray, "m 2"] = field(default_factory=lambda: np.zeros((0, 2)))
    point_rows: Int[np.ndarray, " m"] = field(default_factory=lambda: np.zeros(0, np.int64))
    image: bytes = b""
    image_camera: Camera | None = None
    geopose: GeoPose | None = None


def image_type(encoded: bytes) -> str:
    """Return the type of an image of a map: webp or jpeg."""
    return "webp" if encoded.startswith(b"RIFF") else "jpeg"


@dataclass(frozen=True, eq=False)
class Points:
    """Points in the world (metres), their colours (black without an image), and their mean
    reprojection errors (pixels)."""

    world: Float[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"]
    errors_px: Float[np.ndarray, " n"]

    @staticmethod
    def none() -> Points:
        """Return an empty set of points."""
        return Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0))


@dataclass(frozen=True, eq=False)
class Scene:
    """`views` are in the order of recording. `trajectory` holds all known poses, with or without an
    image or a time. `junctions` are those of a map as JSON, none for results and parts of maps."""

    name: str
    views: Sequence[View]
    points: Points
    trajectory: Sequence[Rigid3]
    georeference: Georeference | None = None
    junctions: Sequence[Mapping[str, Any]] = ()
