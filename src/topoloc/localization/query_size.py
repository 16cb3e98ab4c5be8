"""The size at which a query is looked at: that of its picture, or less.

Key points have sizes in pixels, and those of a picture with far more pixels a radian than the map's pictures had are mostly smaller
than any that the map holds: they crowd out the ones that it does. A long lens and a picture of many megapixels are alike in that. Such a
picture is reduced until its pixels see as much as the map's did; a coarser one stays as it is.
"""

from __future__ import annotations

import cv2
import numpy as np

from topoloc.geometry.camera import Camera
from topoloc.geometry.rough_camera import RoughCamera
from topoloc.places.coarse import Image


def reduced_query(
    image: Image, camera: Camera | RoughCamera, map_focal: float, max_finer: float, max_side_px: int
) -> tuple[np.ndarray, Camera | RoughCamera]:
    """The image with its camera, smaller where it has over `max_finer` times the map's pixels a radian, or a longer side.

    Args:
        map_focal: focal length (pixels) of the map's finest camera: its pixels a radian. A rough camera counts as finer only as
            far as its whole range is.
    """
    height, width = image.shape[:2]
    focal = camera.min_focal if isinstance(camera, RoughCamera) else camera.fx
    scale = max_side_px / max(width, height)
    if focal > max_finer * map_focal:
        scale = min(scale, map_focal / focal)
    if scale >= 1.0:
        return image, camera
    width, height = max(1, round(width * scale)), max(1, round(height * scale))
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), camera.rescaled(width, height)
