"""Render a wall as seen by a camera that looks along it, rectified as by
`topoloc.features.extraction`.

A distant part of the wall is seen at a slant. It fills few pixels, so its rectified image is
blurred, most in the parts farthest from the camera. A camera in the reverse direction sees the wall
from its other end, with the blur at the opposite side. Features learned from both images of one
wall also work in the reverse direction.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float
from numpy.random import Generator

_FOCAL_PX = 380.0  # of a picture of 640 pixels, and of its side views
_NEAREST, _FARTHEST = (
    1.15,
    3.2,
)  # how far ahead of the camera a wall is looked at, as tangents of the angle off the side camera's axis  # noqa: E501
_FINER = 3  # the camera's pixels are means of so many samples each way


def slanted(
    front: Float[np.ndarray, "h w"], is_ahead_right: bool, generator: Generator
) -> Float[np.ndarray, "h w"]:
    """Return the front image of a wall with the detail that a camera beside it, looking along it,
    can see.

    Every pixel stays in place, and has the sharpness of the camera's image. The tangent of pixel x
    grows to the right or to the left.
    """
    height, width = front.shape
    first = generator.uniform(_NEAREST, max(_NEAREST, _FARTHEST - width / _FOCAL_PX))
    to_camera = _camera_from_front(width, height, first, generator.uniform(-0.25, 0.25))
    picture = front if is_ahead_right else front[:, ::-1]
    corners = cv2.perspectiveTransform(_corners(width, height)[None], to_camera)[0]
    low = np.floor(corners.min(axis=0)) - 1.0
    size = np.ceil(corners.max(axis=0) - low + 2.0).astype(int)
    moved = np.array([[1.0, 0.0, -low[0]], [0.0, 1.0, -low[1]], [0.0, 0.0, 1.0]]) @ to_camera
    finer = np.array(
        [[_FINER, 0.0, (_FINER - 1) / 2], [0.0, _FINER, (_FINER - 1) / 2], [0.0, 0.0, 1.0]]
    )
    samples = cv2.warpPerspective(
        np.ascontiguousarray(picture),
        finer @ moved,
        (int(size[0]) * _FINER, int(size[1]) * _FINER),
        borderMode=cv2.BORDER_REPLICATE,
    )
    seen = cv2.resize(samples, (int(size[0]), int(size[1])), interpolation=cv2.INTER_AREA)
    sigma = generator.uniform(0.3, 0.8)  # of the lens and of the pixels' colour filter
    seen = cv2.GaussianBlur(seen, (0, 0), sigma)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    shown = cv2.warpPerspective(
        seen, moved, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE
    )
    return shown if is_ahead_right else np.ascontiguousarray(shown[:, ::-1])


def _camera_from_front(
    width: int, height: int, first: float, above: float
) -> Float[np.ndarray, "3 3"]:
    """Pixels of the camera that looks along the wall, of those of the view from its front; tangents
    grow from `first` at the left end, the horizon lies `above` (a tangent) the middle."""
    front = np.array(
        [
            [1.0 / _FOCAL_PX, 0.0, first],
            [0.0, 1.0 / _FOCAL_PX, above - height / 2.0 / _FOCAL_PX],
            [0.0, 0.0, 1.0],
        ]
    )
    turned = np.array(
        [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    )  # (ahead, down, 1) as (to the side, down, ahead)
    return np.diag([_FOCAL_PX, _FOCAL_PX, 1.0]) @ turned @ front


def _corners(width: int, height: int) -> Float[np.ndarray, "4 2"]:
    return np.array(
        [[0.0, 0.0], [width - 1.0, 0.0], [width - 1.0, height - 1.0], [0.0, height - 1.0]]
    )
