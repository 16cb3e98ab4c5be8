"""Render virtual views of the walls along a camera's path, as if the camera faced them.

On the way back along a corridor, a camera sees the walls under the opposite slant. No local feature
survives this change. A camera that only rotates sees the same rays. So its image follows from the
original one without depth, by a homography or by the mapping of a distorted lens. Turned by 90
degrees to the left and to the right, the camera faces walls, facades and shelves along the path. It
sees them without slant, and alike from both directions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3


@dataclass(frozen=True, eq=False)
class VirtualView:
    """Hold a pinhole camera at the same place, turned to the side, and the image pixel of each of
    its pixels.

    `points_img` are the pixels of the image for the pixels of the virtual camera, NaN outside the
    camera's field. `inside` is True at pixels well within the image, where features are kept.
    """

    name: str
    camera: Camera
    cam_from_virtual: Rigid3
    points_img: Float32[np.ndarray, "a b 2"]
    inside: Bool[np.ndarray, "a b"]

    def virtual_from_world(self, cam_from_world: Rigid3) -> Rigid3:
        """Return the pose of the virtual camera (virtual_from_world) from that of the image's
        camera."""
        return self.cam_from_virtual.inverse() @ cam_from_world

    def picture(self, grey: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "a b"]:
        """Return the image of the virtual camera. Beyond the original image its border is repeated,
        which adds no edges."""
        # The stubs reject None although it is right: OpenCV 5 takes an empty array for a map.
        remap: Any = cv2.remap
        points_img, border = self.points_img, cv2.BORDER_REPLICATE
        return remap(grey, points_img, None, cv2.INTER_LINEAR, borderMode=border)

    def columns_within(self, max_tangent: float) -> slice:
        """Return the columns whose tangent ahead, off the virtual camera's axis, is at most this.
        They show the nearest part of the wall."""
        last = round(max_tangent * self.camera.fx)
        is_left = self.cam_from_virtual.rotation[0, 2] < 0.0
        middle = round(self.camera.cx)
        return slice(0, max(middle + last, 1)) if is_left else slice(max(middle - last, 0), None)

    def select_inside(self, features: Features) -> Features:
        """Return the features inside the rendered area. All dense descriptors are kept."""
        columns, rows = np.rint(features.points_img).astype(int).T
        return replace(features.select(self.inside[rows, columns]), dense=features.dense)

    def to_image_pixels(self, features: Features, camera: Camera) -> Features:
        """Return the same features at the pixels of the original image, taken by `camera`."""
        rays_virtual = self.camera.rays_from_img(features.points_img.astype(np.float64))
        rays = rays_virtual @ self.cam_from_virtual.rotation.T
        return replace(features, points_img=camera.img_from_cam(rays).astype(np.float32))


@lru_cache(maxsize=8)
def make_virtual_views(camera: Camera, max_nearest: float = 1.5) -> tuple[VirtualView, ...]:
    """Return the virtual views to the left and to the right, without those for which the field of
    view is too narrow: it begins beyond `max_nearest`, a tangent off the virtual camera's axis."""
    sides = (("left", -1.0), ("right", 1.0))
    views = (_make_virtual_view(camera, name, sign, max_nearest) for name, sign in sides)
    return tuple(view for view in views if view is not None)


def _make_virtual_view(
    camera: Camera, name: str, sign: float, max_nearest: float
) -> VirtualView | None:
    """Return one virtual view, or None. `sign` is that of x in the camera's frame. The virtual
    camera's x axis points ahead on the left and back on the right."""
    farthest = 3.0  # largest tangent ahead. Walls farther ahead are too slanted to be seen well
    half_height = 0.9  # largest tangent up and down
    max_side_px = 700  # maximum length of the longer side of a virtual view
    margin_px = 8  # features nearer than this to the border of the rendered area are dropped
    cam_from_virtual = Rigid3(
        np.array([[0.0, 0.0, sign], [0.0, 1.0, 0.0], [-sign, 0.0, 0.0]]), np.zeros(3)
    )
    # The largest tangent to the side in the field of view. Rays behind the camera, at the ends of
    # its rows, have no tangent and are ignored.
    row = np.column_stack([np.arange(camera.width), np.full(camera.width, camera.cy)])
    tangent = float(np.nanmax(sign * camera.normalized_from_img(row)[:, 0]))
    if tangent * max_nearest < 1.0:
        return None
    nearest, focal = 1.0 / tangent, camera.fx
    extent = np.array([farthest - nearest, 2.0 * half_height])
    focal *= min(1.0, max_side_px / (focal * extent.max()))
    width, height = np.maximum(np.rint(focal * extent), 1).astype(int)
    # x points ahead on the left and back on the right, so the image lies on one side of the axis or
    # on the other
    cx = -focal * nearest if sign < 0 else focal * farthest
    virtual = Camera.pinhole(int(width), int(height), focal, focal, cx, focal * half_height)
    shape = virtual.height, virtual.width
    rays = virtual.rays_from_img(np.indices(shape, np.float64)[::-1].reshape(2, -1).T)
    # the rotation permutes the axes; a product of matrices would wait for BLAS's threads
    rays_cam = np.column_stack([sign * rays[:, 2], rays[:, 1], -sign * rays[:, 0]])
    points_img = camera.img_from_cam(rays_cam).reshape(*shape, 2)
    reach = np.isfinite(points_img).all(axis=2) & (points_img >= 0).all(axis=2)
    reach &= (points_img <= [camera.width - 1, camera.height - 1]).all(axis=2)
    kernel = np.ones((2 * margin_px + 1,) * 2, np.uint8)
    padded = np.pad(reach.astype(np.uint8), 1)  # by default, pixels beyond the border do not count
    inside = cv2.erode(padded, kernel)[1:-1, 1:-1].astype(bool)
    return VirtualView(name, virtual, cam_from_virtual, points_img.astype(np.float32), inside)
