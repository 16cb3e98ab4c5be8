"""A frame made ready for mapping: the picture that features are taken from, its camera and pose, and where depth comes from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from topoloc.errors import CalibrationError, RecordingError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import Rectification, StereoRig, rectify
from topoloc.geometry.rigid import Rigid3
from topoloc.sequences.frame import DepthImage, Image, StereoFrame
from topoloc.sequences.pictures import grey_image


@dataclass(frozen=True, eq=False)
class MappingView:
    """`picture` is what a person would look at, `grey` what features are taken from; both seen by `camera`.

    Stereo pairs are rectified: `right_grey` and the rectified `rig` are there. RGB-D frames have `depth`, in metres and
    pixels of `camera`, NaN where unknown.
    """

    picture: Image
    grey: UInt8[np.ndarray, "h w"]
    camera: Camera
    world_from_cam: Rigid3
    right_grey: UInt8[np.ndarray, "h w"] | None = None
    rig: StereoRig | None = None
    depth: Float32[np.ndarray, "h w"] | None = None


def mapping_view(frame: StereoFrame, with_depth: bool = True) -> MappingView:
    """Rectify a stereo pair, or bring depth into the picture's camera.

    Without `with_depth` only the picture itself is made ready, which is all that images between the nodes need.

    Raises:
        CalibrationError: the frame has no camera.
        RecordingError: the frame has no pose, or neither a right picture nor depth.
    """
    if frame.camera is None:
        raise CalibrationError(f"{frame.name}: no calibration; put a camera.json into the recording's folder")
    if frame.world_from_cam is None:
        raise RecordingError(f"{frame.name}: no pose")
    if frame.right is not None and frame.rig is not None:
        return _stereo_view(frame, frame.right if with_depth else None, frame.rig, frame.world_from_cam)
    if frame.depth is not None:
        depth = registered_depth(frame.depth, frame.camera) if with_depth else None
        return MappingView(frame.image, grey_image(frame.image), frame.camera, frame.world_from_cam, depth=depth)
    raise RecordingError(f"{frame.name}: a map needs stereo pairs or depth images, this recording has single pictures only")


def _stereo_view(frame: StereoFrame, right: Image | None, rig: StereoRig, world_from_left: Rigid3) -> MappingView:
    right_grey = None if right is None else grey_image(right)
    if rig.is_rectified:
        return MappingView(frame.image, grey_image(frame.image), rig.left, world_from_left, right_grey, rig)
    r = _rectification(rig)
    picture = cv2.remap(frame.image, r.left_map, None, cv2.INTER_LINEAR)
    if right_grey is not None:
        right_grey = cv2.remap(right_grey, r.right_map, None, cv2.INTER_LINEAR)
    world_from_rectified = world_from_left @ r.rectified_from_left.inverse()
    return MappingView(picture, grey_image(picture), r.rig.left, world_from_rectified, right_grey, r.rig)


@lru_cache(maxsize=4)
def _rectification(rig: StereoRig) -> Rectification:
    return rectify(rig)


def registered_depth(depth_image: DepthImage, camera: Camera) -> Float32[np.ndarray, "h w"]:
    """Depth as `camera` sees it: every pixel moved to where `camera` images it, the nearest surface winning."""
    identity = np.allclose(depth_image.cam_from_depth.matrix(), np.eye(4), atol=1e-9)
    if identity and depth_image.camera == camera:
        return depth_image.depth
    rows, columns = np.nonzero(depth_image.depth > 0)  # NaN compares false
    depth = depth_image.depth[rows, columns].astype(np.float64)
    pixels = np.stack([columns, rows], axis=1).astype(np.float64)
    normalized = depth_image.camera.normalized_from_img(pixels)
    points = depth_image.cam_from_depth.apply(np.column_stack([normalized * depth[:, None], depth]))
    target = np.rint(camera.img_from_cam(points))
    inside = (target >= 0).all(axis=1) & (target[:, 0] < camera.width) & (target[:, 1] < camera.height)
    flat = (target[inside, 1] * camera.width + target[inside, 0]).astype(np.int64)
    z = points[inside, 2].astype(np.float32)
    order = np.argsort(-z, kind="stable")  # far to near, so that the nearest is written last
    registered = np.full(camera.width * camera.height, np.nan, np.float32)
    registered[flat[order]] = z[order]
    return registered.reshape(camera.height, camera.width)
