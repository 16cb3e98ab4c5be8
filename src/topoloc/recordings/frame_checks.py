"""Find problems of images, times and frames passed in memory, such as a wrong type, shape or unit.

A float or 16-bit image, seconds instead of nanoseconds, or millimetres instead of metres would not
cause an error by themselves. Queries would only fail to localize. Swapped red and blue channels
cannot be detected. Features use grey values, which change little with the swap.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import StereoRig
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.depth_images import find_depth_problem
from topoloc.recordings.frame import DepthImage, StereoFrame

_MIN_SPAN_NS = 1_000_000
_EXPECTED_IMAGE = "pictures are uint8, grey (height, width) or RGB (height, width, 3)"


def find_image_problem(image: Any) -> str | None:
    """Describe why an array is not a valid image. Return None if it is valid."""
    if not isinstance(image, np.ndarray):
        return f"a picture is a NumPy array, not {type(image).__name__}; {_EXPECTED_IMAGE}"
    shape = "x".join(map(str, image.shape))
    if image.dtype == np.uint16:
        return f"a picture of 16 bits; {_EXPECTED_IMAGE}: (image >> 8).astype(np.uint8)"
    if image.dtype.kind == "f":
        is_unit = image.size > 0 and float(np.nanmax(image)) <= 1.0
        mend = (
            "(255 * image).round().astype(np.uint8)"
            if is_unit
            else "image.round().clip(0, 255).astype(np.uint8)"
        )
        return f"a picture of type {image.dtype}; {_EXPECTED_IMAGE}: {mend}"
    if image.dtype != np.uint8:
        return f"a picture of type {image.dtype}; {_EXPECTED_IMAGE}"
    if 0 in image.shape:
        return f"an empty picture, {shape}"
    if image.ndim == 3 and image.shape[2] == 4:
        return f"a picture with four channels ({shape}); {_EXPECTED_IMAGE}: image[:, :, :3]"
    if image.ndim == 3 and image.shape[0] in (1, 3) and image.shape[2] not in (1, 3):
        return (
            f"a picture with its channels first ({shape}); {_EXPECTED_IMAGE}: image.transpose(1,"
            " 2, 0)"
        )
    if image.ndim == 3 and image.shape[2] == 1:
        return (
            f"a picture of one channel with an axis of its own ({shape}); {_EXPECTED_IMAGE}:"
            " image[:, :, 0]"
        )
    if image.ndim != 2 and (image.ndim != 3 or image.shape[2] != 3):
        return f"an array of shape {shape} is no picture; {_EXPECTED_IMAGE}"
    return None


def find_time_problem(t_ns: Any) -> str | None:
    """Describe why a value is not a time in integer nanoseconds. Return None if it is one."""
    if isinstance(t_ns, bool | np.bool_) or not isinstance(t_ns, int | np.integer):
        return (
            f"t_ns is a time in integer nanoseconds, not {t_ns!r:.40}; of seconds: round(seconds *"
            " 1e9)"
        )
    return None


def find_times_problem(t_ns: Sequence[int]) -> str | None:
    """Describe why the times of a recording are not those of successive frames. Return None if they
    are."""
    for before, after in pairwise(t_ns):
        if after <= before:
            return f"t_ns {after} is not after the one before, {before}"
    if len(t_ns) > 1 and t_ns[-1] - t_ns[0] < _MIN_SPAN_NS:
        return (
            f"{len(t_ns)} frames within {t_ns[-1] - t_ns[0]} ns; t_ns counts nanoseconds, not"
            " seconds, milliseconds or frames"
        )
    return None


def find_frame_problem(frame: StereoFrame) -> str | None:
    """Describe in one line the problem of a frame in memory. Return None if it is consistent."""
    problem = (
        find_image_problem(frame.image)
        or find_time_problem(frame.t_ns)
        or _find_size_problem("the picture", frame.image, frame.camera)
    )
    if (
        problem is None
        and frame.world_from_cam is not None
        and not isinstance(frame.world_from_cam, Rigid3)
    ):
        problem = (
            f"world_from_cam is a Rigid3, not {type(frame.world_from_cam).__name__}; of a 4x4"
            " matrix: Rigid3.from_matrix(matrix)"
        )
    return (
        problem
        or _find_stereo_problem(frame.camera, frame.image, frame.right, frame.rig)
        or _find_depth_problem(frame.depth)
    )


def _find_stereo_problem(
    camera: Camera | None, image: np.ndarray, right: Any, rig: StereoRig | None
) -> str | None:
    if right is None and rig is None:
        return None
    if right is None or rig is None:
        return (
            f"a stereo pair needs `right` and `rig`; {'rig' if rig is None else 'right'} is missing"
        )
    if camera != rig.left:
        return "`camera` is that of the left picture, rig.left, and here is another one"
    problem = find_image_problem(right) or _find_size_problem("the right picture", right, rig.right)
    if problem is None and right.shape[:2] != image.shape[:2]:
        problem = "the left and right picture differ in size"
    return problem


def _find_depth_problem(depth: Any) -> str | None:
    if depth is None:
        return None
    if not isinstance(depth, DepthImage):
        return f"depth is a DepthImage(depth, camera), not {type(depth).__name__}"
    array = depth.depth
    if not isinstance(array, np.ndarray) or array.ndim != 2 or array.dtype != np.float32:
        what = (
            f"{array.dtype} of shape {array.shape}"
            if isinstance(array, np.ndarray)
            else type(array).__name__
        )
        meant = "depth is float32 (height, width) in metres, NaN where unknown"
        return f"{meant}, not {what}; of millimetres: depth.astype(np.float32) / 1000"
    return _find_size_problem("the depth image", array, depth.camera) or find_depth_problem(array)


def _find_size_problem(what: str, image: np.ndarray, camera: Camera | None) -> str | None:
    if camera is None or image.shape[:2] == (camera.height, camera.width):
        return None
    return f"{what} is {image.shape[1]}x{image.shape[0]}, its camera {camera.width}x{camera.height}"
