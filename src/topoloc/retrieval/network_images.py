"""The settings and the input of the learned coarse localizers' networks. This module needs no
torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

import cv2
import numpy as np
from jaxtyping import UInt8

from topoloc.bounds import Between
from topoloc.recordings.stored_images import read_stored_image
from topoloc.retrieval.coarse import Image

BackboneName = Literal["squeezenet1_1", "vgg11", "vgg16", "efficientnet_lite0", "compact"]


@dataclass(frozen=True)
class NetworkInputConfig:
    """Hold the size of the network's input. An image is cropped to the aspect ratio of the mapping
    images, reduced, and stretched to this size."""

    width_px: Annotated[int, Between(32, 2048)] = 224
    """Width of the network's input."""
    height_px: Annotated[int, Between(32, 2048)] = 168
    """Height of the network's input."""


@dataclass(frozen=True)
class ClassifierNetworkConfig:
    """Hold the settings of cnn-fc's network."""

    picture: NetworkInputConfig = field(default_factory=NetworkInputConfig)


@dataclass(frozen=True)
class VladNetworkConfig(ClassifierNetworkConfig):
    """Hold the settings of vlad-nn's network: NetVLAD of a network's features."""

    depth: Annotated[int | None, Between(1, 100)] = None
    """Number of layers of the backbone's `features` that are used (None: the best measured number
    for each backbone)."""


@dataclass(frozen=True)
class PooledNetworkConfig(VladNetworkConfig):
    """Hold the settings of cnn-nn's network: pooled features of a pretrained network."""

    grid_rows: Annotated[int, Between(1, 32)] = 2
    """Rows of pooling cells. Cells help because neighbouring nodes see the same objects at other
    image positions."""
    grid_columns: Annotated[int, Between(1, 32)] = 3
    """Columns of pooling cells."""
    power: Annotated[float, Between(1, 100)] = 3.0
    """Exponent of the generalised mean (Radenovic et al. 2018): 1 is the mean, infinity the
    maximum."""


RgbImage = UInt8[np.ndarray, "_ _ 3"]
RgbImages = UInt8[np.ndarray, "_ _ _ 3"]


@dataclass(frozen=True)
class ImageShape:
    """Hold the size of the mapping images. Queries are cropped and reduced to it before they are
    stretched to the network's size."""

    width: int
    height: int

    def fit(self, image: Image) -> RgbImage:
        """Return the centre of the image in this aspect ratio, in colour. It is reduced to this
        size if it is larger."""
        height, width = image.shape[:2]
        scale = min(width / self.width, height / self.height)
        rows, columns = max(1, round(self.height * scale)), max(1, round(self.width * scale))
        top, left = (height - rows) // 2, (width - columns) // 2
        image = image[top : top + rows, left : left + columns]
        if scale > 1.0:
            image = cv2.resize(image, (self.width, self.height), interpolation=cv2.INTER_AREA)
        return image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)


def decode_stored_image(jpeg: bytes) -> RgbImage:
    """Return a stored mapping image in colour. Raises MapError if it is damaged or too large."""
    image = read_stored_image("a mapping image of the map", jpeg, (4000, 4000))
    return image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)


def prepare_network_images(
    images: Sequence[Image], shape: ImageShape, config: NetworkInputConfig
) -> RgbImages:
    """Return images as network input: cropped to the shape of the mapping images and stretched to
    the network's size."""
    size, resized = (config.width_px, config.height_px), []
    for image in map(shape.fit, images):
        shrinks = image.shape[1] >= size[0] and image.shape[0] >= size[1]
        method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        resized.append(cv2.resize(image, size, interpolation=method))
    return np.stack(resized)
