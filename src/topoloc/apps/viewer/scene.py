"""What is shown or exported, whatever the form: pictures with known poses, and the points that they
show. Data only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int, UInt8

from topoloc import Camera, GeoPose, Georeference, Rigid3


@dataclass(frozen=True, eq=False)
class View:
    """A picture and where it was taken. `name` is that of its file; `t_ns` is None where it has no
    time.

    Pixel `points_img[k]` of `camera` shows point `point_rows[k]` of the scene, -1 for none. `jpeg`
    is the picture, encoded, possibly smaller than `camera`, and seen by `jpeg_camera`; empty where
    it is not at hand.
    """

    name: str
    world_from_cam: Rigid3
    t_ns: int | None = None
    camera: Camera | None = None
    session_id: int = 0
    points_img: Float[np.ndarray, "m 2"] = field(default_factory=lambda: np.zeros((0, 2)))
    point_rows: Int[np.ndarray, " m"] = field(default_factory=lambda: np.zeros(0, np.int64))
    jpeg: bytes = b""
    jpeg_camera: Camera | None = None
    geopose: GeoPose | None = None


@dataclass(frozen=True, eq=False)
class Points:
    """Points in the world (metres), their colours where pictures show them (else black), and the
    mean reprojection error (pixels)."""

    world: Float[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"]
    errors_px: Float[np.ndarray, " n"]

    @staticmethod
    def none() -> Points:
        return Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0))


@dataclass(frozen=True, eq=False)
class Scene:
    """`views` in the order in which they were taken; `trajectory` are all poses that are known,
    with or without a picture or a time."""

    name: str
    views: Sequence[View]
    points: Points
    trajectory: Sequence[Rigid3]
    georeference: Georeference | None = None
