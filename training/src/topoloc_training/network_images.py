"""Make images the input of the learned coarse localizers' networks. This module needs no torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8

from topoloc.retrieval.coarse import Image
from topoloc_training.classifier_config import NetworkInputConfig

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
