"""Prepare a frame for measurements: the image for feature extraction, its camera model and its
depth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from topoloc.compiled import kernel
from topoloc.errors import CalibrationError, RecordingError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import StereoRig, rectify
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import DepthImage, Image, StereoFrame, to_grey
from topoloc.recordings.image_mask import scale_mask


@kernel(error_model="numpy")
def register_undistorted(depth, normalized, rotation, translation, focal, centre, registered):
    """Register depth to a camera without distortion in one pass, without storing points.

    `normalized` (h * w, 2) holds the pixels on the depth camera's plane z = 1, `focal` and `centre`
    the focal lengths and the principal point (x and y) of the other camera. NaN marks pixels of
    `registered` without depth.
    """
    (height, width), (rows, columns) = depth.shape, registered.shape
    for row in range(height):
        for column in range(width):
            z = np.float64(depth[row, column])
            if not z > 0.0:  # NaN compares false
                continue
            x, y = normalized[row * width + column, 0] * z, normalized[row * width + column, 1] * z
            px = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0]
            py = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1]
            pz = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2]
            if not pz > 1e-9:
                continue
            x, y = px / pz * focal[0] + centre[0], py / pz * focal[1] + centre[1]
            if x >= -0.5 and y >= -0.5 and x < columns - 0.5 and y < rows - 0.5:
                at = int(np.rint(y)), int(np.rint(x))
                if not registered[at] <= np.float32(pz):  # also true for NaN
                    registered[at] = np.float32(pz)


_cached_rectify = lru_cache(maxsize=4)(rectify)


@dataclass(frozen=True, eq=False)
class PreparedFrame:
    """Hold a frame after rectification or depth registration.

    `picture` is the image for display, and `grey` the image for feature extraction. Both belong to
    `camera`. Stereo pairs are rectified and have `right_grey` and the rectified `rig`. RGB-D frames
    have `depth` in metres, NaN if unknown. It has the view of `camera` and may be coarser than
    `grey`. `view_from_cam` is the rotation of the frame's camera by rectification. `raw_camera` is
    the camera before that.
    """

    picture: Image
    grey: UInt8[np.ndarray, "h w"]
    camera: Camera
    view_from_cam: Rigid3
    right_grey: UInt8[np.ndarray, "h w"] | None = None
    rig: StereoRig | None = None
    depth: Float32[np.ndarray, "coarse_h coarse_w"] | None = None
    raw_camera: Camera | None = None

    @property
    def is_located(self) -> bool:
        """Return whether a pair, or depth of every pixel, locates the features without other
        images."""
        has_depth = self.depth is not None and self.depth.shape == self.grey.shape
        return self.right_grey is not None or has_depth


def prepare_frame(frame: StereoFrame, with_depth: bool = True) -> PreparedFrame:
    """Rectify a stereo pair, or register depth to the camera of the image.

    Args:
        frame: the frame.
        with_depth: False prepares only the image itself. A frame read without its right image
            (`read_left_frame`) is rectified, too.

    Raises:
        CalibrationError: the frame has no camera model.
        RecordingError: `with_depth` is True and the frame has neither a right image nor depth.
    """
    if with_depth and frame.right is None and frame.depth is None:
        raise RecordingError(
            f"{frame.name}: single pictures only; SLAM needs stereo pairs or depth images, a map of"
            " single pictures their poses (topoloc build --trajectory FILE, or of a COLMAP model)"
        )
    if frame.camera is None:
        raise CalibrationError(
            f"{frame.name}: no calibration; put a camera.json into the recording's folder"
        )
    if frame.rig is not None and (frame.right is not None or not with_depth):
        return _prepare_stereo(frame.image, frame.right if with_depth else None, frame.rig)
    grey, depth = to_grey(frame.image), None
    if with_depth and frame.depth is not None:
        depth = register_depth(frame.depth, frame.camera)
    return PreparedFrame(frame.image, grey, frame.camera, Rigid3.identity(), depth=depth)


def undistort_frame(frame: StereoFrame, max_side_px: int) -> PreparedFrame:
    """Return the frame's own image without distortion, scaled down if a side is longer than
    `max_side_px`.

    Raises:
        CalibrationError: the frame has no camera model.
    """
    view = prepare_frame(frame, with_depth=False)
    grey, camera = downscale_image(view.grey, view.camera, max_side_px)
    if camera.is_distorted:
        grey, camera = _remap(grey, _undistortion_map(camera)), camera.undistorted()
    return PreparedFrame(grey, grey, camera, view.view_from_cam)


def downscale_image(
    grey: UInt8[np.ndarray, "h w"], camera: Camera, max_side_px: int
) -> tuple[UInt8[np.ndarray, "a b"], Camera]:
    """Return the image and its camera, reduced if a side is longer than `max_side_px`."""
    scale = max_side_px / max(grey.shape)
    if scale >= 1.0:
        return grey, camera
    size = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA), camera.rescaled(*size)


@lru_cache(maxsize=4)
def _undistortion_map(camera: Camera) -> Float32[np.ndarray, "h w 2"]:
    normalized = _normalized_pixels(camera.undistorted(), camera.width, camera.height)
    points_img = camera.img_from_cam(np.column_stack([normalized, np.ones(len(normalized))]))
    pixels = np.nan_to_num(points_img, nan=-1.0).astype(np.float32)
    return pixels.reshape(camera.height, camera.width, 2)


def _prepare_stereo(image: Image, right: Image | None, rig: StereoRig) -> PreparedFrame:
    right_grey = None if right is None else to_grey(right)
    if rig.is_rectified:
        return PreparedFrame(image, to_grey(image), rig.left, Rigid3.identity(), right_grey, rig)
    r = _cached_rectify(rig)
    picture = _remap(image, r.left_map)
    if right_grey is not None:
        right_grey = _remap(right_grey, r.right_map)
    camera = r.rig.left
    if rig.left.mask is not None:
        scaled = scale_mask(rig.left.mask, camera.width, camera.height)
        camera = replace(camera, mask=_remap(scaled, r.left_map) > 0)
    return PreparedFrame(
        picture,
        to_grey(picture),
        camera,
        r.rectified_from_left,
        right_grey,
        r.rig,
        raw_camera=rig.left,
    )


def _remap(picture: Image, pixel_map: Float32[np.ndarray, "h w 2"]) -> Image:
    # The stubs reject None although it is correct: OpenCV 5 uses an empty second map as a map.
    remap: Any = cv2.remap
    return remap(picture, pixel_map, None, cv2.INTER_LINEAR)


def register_depth(depth_image: DepthImage, camera: Camera) -> Float32[np.ndarray, "h w"]:
    """Register depth to `camera`. Each pixel moves to its projection, and the nearest surface
    wins. Depth that is coarser than the image of `camera` stays so."""
    height, width = depth_image.depth.shape
    identity = np.allclose(depth_image.cam_from_depth.matrix(), np.eye(4), atol=1e-9)
    is_finer = width > camera.width
    if identity and depth_image.camera in (camera, camera.rescaled(width, height)) and not is_finer:
        return depth_image.depth
    density = depth_image.camera.fx / camera.fx
    if density < 0.7:  # else most pixels of the image would get no depth
        size = round(density * camera.width), round(density * camera.height)
        camera = camera.rescaled(*size)
    pose = depth_image.cam_from_depth
    normalized = _normalized_pixels(depth_image.camera, width, height)
    registered = np.full((camera.height, camera.width), np.nan, np.float32)
    if not camera.is_distorted:
        focal, centre = (camera.fx, camera.fy), (camera.cx, camera.cy)
        motion = pose.rotation, pose.translation
        register_undistorted(depth_image.depth, normalized, *motion, focal, centre, registered)
        return registered
    depth = depth_image.depth.reshape(-1, 1).astype(np.float64)
    points = pose.apply(
        (np.column_stack([normalized, np.ones_like(depth)]) * depth)[depth[:, 0] > 0]
    )
    columns, rows = np.rint(camera.img_from_cam(points)).T
    inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    pixels = rows[inside].astype(int), columns[inside].astype(int)
    np.fmin.at(registered, pixels, points[inside, 2].astype(np.float32))  # the nearest point
    return registered


@lru_cache(maxsize=4)
def _normalized_pixels(camera: Camera, width: int, height: int) -> Float[np.ndarray, "n 2"]:
    """Return every pixel of an image, row by row, on the plane z = 1."""
    pixels = np.indices((height, width), dtype=np.float64)[::-1].reshape(2, -1).T
    return camera.normalized_from_img(pixels)
