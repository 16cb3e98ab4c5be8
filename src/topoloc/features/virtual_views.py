"""What a camera sees of the walls along its way, as if it stood before them.

Whoever walks back along a corridor sees its walls again, but under the opposite slant: no local
feature survives that. A camera that is turned without being moved sees the same rays, so its
picture follows from the first one without any depth (a homography; for a lens with distortion, its
own mapping). Turned by a right angle to the left and to the right, it looks straight at walls,
facades and shelves that run along the way, and shows them without slant, the same from either
direction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from topoloc.bounds import Between
from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3


@dataclass(frozen=True)
class VirtualViewConfig:
    """How much of the walls is looked at. Tangents are those of angles off the side camera's axis:
    1 is 45 degrees ahead."""

    farthest: Annotated[float, Between(0.1, 10)] = 3.0
    """Farther ahead walls are too slanted to be seen well."""
    half_height: Annotated[float, Between(0.1, 10)] = 0.9
    """How far up and down."""
    nearest: Annotated[float, Between(0.1, 10)] = 1.5
    """A lens so narrow that it sees nothing nearer than this has no side views."""
    max_side_px: Annotated[int, Between(64, 4096)] = 700
    """The longer side of a side view, at most."""
    margin_px: Annotated[int, Between(0, 1000)] = 8
    """Features nearer than this to the border of what the picture holds are none."""


@dataclass(frozen=True, eq=False)
class VirtualView:
    """A pinhole camera in the same place, turned to the side, and where in the picture each of its
    pixels lies.

    `points_img` are the picture's pixels of the side camera's, NaN where the picture does not
    reach; `inside` is True where a feature lies well within what it holds.
    """

    name: str
    camera: Camera
    cam_from_virtual: Rigid3
    points_img: Float32[np.ndarray, "a b 2"]
    inside: Bool[np.ndarray, "a b"]

    def virtual_from_world(self, cam_from_world: Rigid3) -> Rigid3:
        """The pose of the side camera (side_from_world), of that of the picture's camera."""
        return self.cam_from_virtual.inverse() @ cam_from_world

    def picture(self, grey: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "a b"]:
        """What the side camera sees. Beyond the picture its border goes on, which makes no edges of
        its own."""
        # None is right here, whatever the stubs say: OpenCV 5 takes an empty second map for a map.
        return cv2.remap(
            grey,
            self.points_img,
            None,  # pyright: ignore
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )

    def select_inside(self, features: Features) -> Features:
        """The features that lie in what the picture holds, with the dense descriptors of all of
        it."""
        columns, rows = np.rint(features.points_img).astype(int).T
        return replace(features.select(self.inside[rows, columns]), dense=features.dense)

    def to_image_pixels(self, features: Features, camera: Camera) -> Features:
        """The same features at the pixels of the picture itself, which `camera` took."""
        rays = (
            self.camera.rays_from_img(features.points_img.astype(np.float64))
            @ self.cam_from_virtual.rotation.T
        )
        return replace(features, points_img=camera.img_from_cam(rays).astype(np.float32))


@lru_cache(maxsize=8)
def make_virtual_views(camera: Camera, config: VirtualViewConfig) -> tuple[VirtualView, ...]:
    """The views to the left and to the right; none where the lens is too narrow for that."""
    views = (
        _make_virtual_view(camera, name, sign, config)
        for name, sign in (("left", -1.0), ("right", 1.0))
    )
    return tuple(view for view in views if view is not None)


def _make_virtual_view(
    camera: Camera, name: str, sign: float, config: VirtualViewConfig
) -> VirtualView | None:
    """`sign` is that of x in the camera's frame; the side camera's own x axis points ahead on the
    left, back on the right."""
    cam_from_virtual = Rigid3(
        np.array([[0.0, 0.0, sign], [0.0, 1.0, 0.0], [-sign, 0.0, 0.0]]), np.zeros(3)
    )
    tangent = _max_tangent(camera, sign)
    if tangent * config.nearest < 1.0:
        return None
    nearest, focal = 1.0 / tangent, camera.fx
    extent = np.array([config.farthest - nearest, 2.0 * config.half_height])
    focal *= min(1.0, config.max_side_px / (focal * extent.max()))
    width, height = np.maximum(np.rint(focal * extent), 1).astype(int)
    # x is ahead on the left and back on the right: the picture lies on the one or the other side of
    # the axis
    cx = -focal * nearest if sign < 0 else focal * config.farthest
    virtual = Camera.pinhole(int(width), int(height), focal, focal, cx, focal * config.half_height)
    points_img = _points_img(camera, virtual, cam_from_virtual)
    reach = np.isfinite(points_img).all(axis=2) & (points_img >= 0).all(axis=2)
    reach &= (points_img <= [camera.width - 1, camera.height - 1]).all(axis=2)
    kernel = np.ones((2 * config.margin_px + 1,) * 2, np.uint8)
    inside = cv2.erode(
        np.asarray(reach, np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0
    ).astype(bool)  # pyright: ignore
    return VirtualView(name, virtual, cam_from_virtual, points_img.astype(np.float32), inside)


def _max_tangent(camera: Camera, sign: float) -> float:
    """How far to the side the lens sees; what it sees behind itself, at the ends of its rows, has
    no tangent and does not count."""
    row = np.column_stack(
        [np.arange(camera.width, dtype=np.float64), np.full(camera.width, camera.cy)]
    )
    return float(np.nanmax(sign * camera.normalized_from_img(row)[:, 0]))


def _points_img(
    camera: Camera, virtual: Camera, cam_from_virtual: Rigid3
) -> Float[np.ndarray, "a b 2"]:
    columns, rows = np.meshgrid(
        np.arange(virtual.width, dtype=np.float64), np.arange(virtual.height, dtype=np.float64)
    )
    rays = virtual.rays_from_img(np.column_stack([columns.ravel(), rows.ravel()]))
    return camera.img_from_cam(rays @ cam_from_virtual.rotation.T).reshape(
        virtual.height, virtual.width, 2
    )
