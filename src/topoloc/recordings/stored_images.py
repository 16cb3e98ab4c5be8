"""Encode and read images that a map stores. Their size is checked before they are decoded, so that
a damaged map cannot fill the memory."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt8

from topoloc.errors import MapError, UnreadableImageError
from topoloc.recordings.frame import Image
from topoloc.recordings.image_io import EncodedImage, read_image


def encode_jpeg(image: Image, quality: int) -> bytes:
    """Encode an image as JPEG. The same image gives the same bytes."""
    return _encode(image, ".jpg", [cv2.IMWRITE_JPEG_QUALITY, quality])


def encode_webp(image: Image, quality: int) -> bytes:
    """Encode an image as WebP. The same image gives the same bytes."""
    return _encode(image, ".webp", [cv2.IMWRITE_WEBP_QUALITY, quality])


def _encode(image: Image, suffix: str, options: list[int]) -> bytes:
    bgr = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return cv2.imencode(suffix, bgr, options)[1].tobytes()


def read_stored_image(owner: str, data: bytes, max_size: tuple[int, int]) -> Image:
    """Return a stored image of at most this width and height (pixels).

    Raises:
        MapError: the image is damaged or larger. The message names its owner.
    """
    with MapError.at(f"{owner} is damaged", UnreadableImageError):
        return read_image(EncodedImage("its image", data), as_stored=True, max_size=max_size)


def decode_stored_image(jpeg: bytes) -> UInt8[np.ndarray, "h w 3"]:
    """Return a stored mapping image in colour. Raises MapError if it is damaged or too large."""
    image = read_stored_image("a mapping image of the map", jpeg, (4000, 4000))
    return image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
