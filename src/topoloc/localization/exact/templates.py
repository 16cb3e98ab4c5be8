"""Hold the images of nodes for the comparison with a query: grey levels, and colours in small.

Patches are aligned with the grey levels (`patch_alignment.py`), colours are compared
(`appearance.py`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from topoloc.errors import MapError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.topomap import TopoNode
from topoloc.recordings.frame import Image, to_grey


@dataclass(frozen=True, eq=False)
class NodeTemplate:
    """Hold the image of a node. `camera` has the size of the image. An image that is missing or
    damaged `is_black`. `colours` are its `small_colours`."""

    image: UInt8[np.ndarray, "h w"]
    camera: Camera
    world_from_cam: Rigid3
    is_black: bool = False
    colours: Float[np.ndarray, "rows columns 3"] | None = None

    @staticmethod
    def of_node(node: TopoNode) -> NodeTemplate:
        """Return the stored image of a node in grey."""
        try:
            image = node.read_image()
        except MapError:
            image = None
        grey = np.zeros((2, 2), np.uint8) if image is None else to_grey(image)
        camera = node.camera.rescaled(*grey.shape[::-1])
        colours = None if image is None else small_colours(image)
        return NodeTemplate(grey, camera, node.summary.world_from_cam, image is None, colours)


_COLOURS = np.array([[1.0, 1.0, 1.0], [3.0, -3.0, 0.0], [-1.5, -1.5, 3.0]]) / 3.0


def small_colours(image: Image) -> Float[np.ndarray, "rows columns 3"] | None:
    """Return the logarithms of brightness, red over green and blue over yellow in 80 columns. None:
    the image is grey."""
    if image.ndim == 2:
        return None
    size = 80, max(1, round(80 * image.shape[0] / image.shape[1]))
    darkest = 8.0  # levels below are noise
    levels = np.log(cv2.resize(image, size, interpolation=cv2.INTER_AREA) + np.float32(darkest))
    return cv2.transform(levels, _COLOURS)


def sample_colours(
    colours: Float[np.ndarray, "rows columns 3"], places: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 3"]:
    """Return the colours at places, which are pixels over the image size."""
    return _interpolate(colours, *(places * colours.shape[1::-1] - 0.5).T)


def _interpolate(
    colours: Float[np.ndarray, "rows columns 3"],
    x: Float[np.ndarray, " n"],
    y: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n 3"]:
    pixels = x.astype(np.float32), y.astype(np.float32)
    sampled = cv2.remap(colours, *pixels, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return sampled.reshape(-1, 3).astype(np.float64)


class NodeTemplates(tuple[NodeTemplate, ...]):
    """Hold the images of some nodes."""

    @cached_property
    def images(self) -> tuple[UInt8[np.ndarray, "k h w"], Int[np.ndarray, "k 2"]]:
        """Return the grey images, padded to one size, and their heights and widths."""
        sizes = np.array([one.image.shape for one in self]).reshape(-1, 2)
        images = np.zeros((len(sizes), *sizes.max(axis=0, initial=1)), np.uint8)
        for k, one in enumerate(self):
            images[k, : sizes[k, 0], : sizes[k, 1]] = one.image
        return images, sizes


@dataclass(frozen=True, eq=False)
class PointTemplates:
    """Hold the images of the nodes of points: that of point k is `templates[of_point[k]]`."""

    templates: NodeTemplates
    of_point: Int[np.ndarray, " n"]

    def turned_by(self, rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "n 3 3"]:
        """Return the product of a rotation with that of world_from_cam of the node of each
        point."""
        turned = rotation @ np.array([one.world_from_cam.rotation for one in self.templates])
        return turned[self.of_point]

    @property
    def origins(self) -> Float[np.ndarray, "n 3"]:
        """Return the position (metres, world) of the node of each point."""
        return np.array([one.world_from_cam.translation for one in self.templates])[self.of_point]

    def in_nodes(self, points_world: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return points in the camera frames of their nodes, metres."""
        # one product with the rotations of all nodes is quicker than one a point
        rotations = np.array([one.world_from_cam.rotation for one in self.templates])
        places = points_world - self.origins
        turned = (places @ np.hstack(list(rotations))).reshape(len(places), -1, 3)
        return turned[np.arange(len(places)), self.of_point]

    def project(self, in_nodes: Float[np.ndarray, "k n 3"]) -> Float[np.ndarray, "k n 2"]:
        """Return the pixels of k positions of each point, given in the frame of its node."""
        pixels, cameras = np.empty((*in_nodes.shape[:2], 2)), [one.camera for one in self.templates]
        if len(set(cameras)) == 1:
            return cameras[0].img_from_cam(in_nodes.reshape(-1, 3)).reshape(pixels.shape)
        for camera in set(cameras):
            rows = np.flatnonzero(np.array([one == camera for one in cameras])[self.of_point])
            projected = camera.img_from_cam(in_nodes[:, rows].reshape(-1, 3))
            pixels[:, rows] = projected.reshape(-1, len(rows), 2)
        return pixels

    def sample_colours(self, points_world: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the `small_colours` of points in the images of their nodes, NaN where grey."""
        pixels = self.project(self.in_nodes(points_world)[None])[0]
        sizes = np.array([(one.camera.width, one.camera.height) for one in self.templates])
        heights = np.array(
            [0 if one.colours is None else len(one.colours) for one in self.templates]
        )
        colours, known = np.full(points_world.shape, np.nan), heights[self.of_point] > 0
        if not known.any():
            return colours
        # small images one below the other
        image = np.vstack([one.colours for one in self.templates if one.colours is not None])
        of_point, num_columns = self.of_point[known], image.shape[1]
        x, y = (pixels[known] / sizes[of_point]).T
        rows = np.clip(y * heights[of_point] - 0.5, 0.0, heights[of_point] - 1.0)
        rows += (np.cumsum(heights) - heights)[of_point]
        colours[known] = _interpolate(image, x * num_columns - 0.5, rows)
        return colours
