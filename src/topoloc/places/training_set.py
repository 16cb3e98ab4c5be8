"""What a coarse localizer learns from: the mapping images, small, each with its node and its distances to all of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from topoloc.errors import MapError
from topoloc.geometry.rigid import Rigid3
from topoloc.places.classifier_config import PictureConfig
from topoloc.places.coarse import Image

Progress = Callable[[str, int, int], None]
"""Called with a stage's name, steps done and steps in all."""
RgbPicture = UInt8[np.ndarray, "_ _ 3"]
RgbPictures = UInt8[np.ndarray, "_ _ _ 3"]


@dataclass(frozen=True, eq=False)
class TrainingSet:
    """The mapping images of a map.

    `jpegs` are their pictures, `world_from_cams` their poses, `node_ids` the node nearest to each by Eq. 1 and
    `node_distances` (metres) D_total of each image to each node; `d_thresh` (metres) and `lambda_rot` (metres a
    radian) are those of Eq. 1.
    """

    jpegs: Sequence[bytes]
    world_from_cams: Sequence[Rigid3]
    node_ids: Int[np.ndarray, " n"]
    node_distances: Float[np.ndarray, "n nodes"]
    d_thresh: float
    lambda_rot: float

    @property
    def num_nodes(self) -> int:
        return self.node_distances.shape[1]

    def image_distances(self) -> Float[np.ndarray, "n n"]:
        """D_total of Eq. 1 (metres) between the images."""
        centres = np.stack([pose.translation for pose in self.world_from_cams])
        rotations = np.stack([pose.rotation for pose in self.world_from_cams]).reshape(len(centres), 9)
        angles = np.arccos(np.clip((rotations @ rotations.T - 1.0) / 2.0, -1.0, 1.0))
        return np.linalg.norm(centres[:, None] - centres[None], axis=2) + self.lambda_rot * angles


@dataclass(frozen=True)
class PictureShape:
    """The mapping pictures' size: queries are cut and reduced to it before they are stretched to the network's."""

    width: int
    height: int

    def fit(self, image: Image) -> RgbPicture:
        """The middle of the image in this shape, reduced to this size where it is larger; colour."""
        height, width = image.shape[:2]
        scale = min(width / self.width, height / self.height)
        rows, columns = max(1, round(self.height * scale)), max(1, round(self.width * scale))
        top, left = (height - rows) // 2, (width - columns) // 2
        image = image[top : top + rows, left : left + columns]
        if scale > 1.0:
            image = cv2.resize(image, (self.width, self.height), interpolation=cv2.INTER_AREA)
        return image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)


def decode_pictures(training_set: TrainingSet) -> tuple[list[RgbPicture], PictureShape]:
    """The mapping pictures in colour, and the size that most of them have. Raises MapError where one is damaged."""
    pictures = [decode_picture(jpeg) for jpeg in training_set.jpegs]
    sizes, counts = np.unique([picture.shape[1::-1] for picture in pictures], axis=0, return_counts=True)
    width, height = sizes[int(counts.argmax())]
    return pictures, PictureShape(int(width), int(height))


def decode_picture(jpeg: bytes) -> RgbPicture:
    """A stored picture in colour. Raises MapError where it is damaged."""
    picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise MapError("the map is damaged: a mapping image is no picture")
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


def network_pictures(images: Sequence[Image], shape: PictureShape, config: PictureConfig) -> RgbPictures:
    """Images as a network takes them: all in the mapping pictures' shape, stretched to the network's size."""
    size = (config.width_px, config.height_px)
    return np.stack([_stretched(shape.fit(image), size) for image in images])


def _stretched(picture: RgbPicture, size: tuple[int, int]) -> RgbPicture:
    shrinks = picture.shape[1] >= size[0] and picture.shape[0] >= size[1]
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
