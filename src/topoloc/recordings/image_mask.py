"""Leave out the part of images that moves with the camera, by a mask: an image that is white where
pixels are used and black elsewhere.

A camera carries its mask (`Camera.mask`). Pixels that are left out become a smooth continuation of
their surroundings, so that no step finds key points or texture there.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from topoloc.errors import CalibrationError
from topoloc.geometry.camera import Camera, UncalibratedCamera
from topoloc.recordings.frame import (
    DepthImage,
    Image,
    SequenceView,
    StereoFrame,
    StereoSequence,
    to_grey,
)

Mask = Bool[np.ndarray, "mask_h mask_w"]
_AnyCamera = TypeVar("_AnyCamera", bound=Camera | UncalibratedCamera)


def read_mask(path: str | Path) -> Mask:
    """Read a mask. True pixels are used.

    Raises:
        UnreadableImageError: the file is no image.
        CalibrationError: it leaves out every pixel, or is a folder.
    """
    from topoloc.recordings.image_io import read_image  # queries without a mask read no file

    if Path(path).is_dir():
        raise CalibrationError(
            f"{path}: a mask is one image for all pictures, not a folder; give the image"
        )
    grey = to_grey(read_image(Path(path)))
    if grey.max() < 128:
        raise CalibrationError(
            f"{path}: a mask without a white pixel leaves out the whole picture (its brightest"
            f" value is {grey.max()}); white (255) is used, black (0) left out"
        )
    return grey >= 128


def with_mask(camera: _AnyCamera, mask: Mask) -> _AnyCamera:
    """Return the camera with a mask of its image, of any size.

    Raises:
        CalibrationError: the image has another shape than the mask.
    """
    height, width = mask.shape
    # more than one pixel of rounding
    if abs(camera.width * height - camera.height * width) > max(height, width):
        raise CalibrationError(
            f"the mask has {width}x{height} pixels, the picture {camera.width}x{camera.height}: not"
            " of one shape; make the mask of a picture of this camera"
        )
    return replace(camera, mask=mask)


def scale_mask(mask: Mask, width: int, height: int) -> UInt8[np.ndarray, "h w"]:
    """Return the mask for an image of this size: 1 where its pixels are used, 0 elsewhere."""
    nearest = cv2.INTER_NEAREST_EXACT
    return cv2.resize(mask.astype(np.uint8), (width, height), interpolation=nearest)


def fill_masked(image: Image, mask: Mask) -> Image:
    """Return the image with the pixels that are left out replaced by a smooth continuation of those
    around them."""
    cell_px, reach = 16, 3
    height, width = image.shape[:2]
    used = scale_mask(mask, width, height)
    if used.all():
        return image
    size = max(1, width // cell_px), max(1, height // cell_px)
    is_used = used.reshape(height, width, *(1,) * (image.ndim - 2))
    share = cv2.resize(used.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    sums = cv2.resize(image * is_used, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    known = share > 0.5
    means = (sums.T / np.where(known, share, 1.0).T).T.round().clip(0, 255).astype(np.uint8)
    small = cv2.inpaint(means, (~known).astype(np.uint8), reach, cv2.INPAINT_NS)
    smooth = cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.where(is_used > 0, image, smooth)


def mask_recording(sequence: StereoSequence, mask: Mask) -> StereoSequence:
    """Return a recording whose images and cameras have a mask. Frames raise CalibrationError: their
    images have another shape than the mask."""
    rows = list(range(len(sequence)))
    apart = tuple(getattr(sequence, "apart", ()))
    return _MaskedView(sequence, rows, list(sequence.poses), apart, mask=mask)


@dataclass(frozen=True, eq=False, repr=False)
class _MaskedView(SequenceView):
    mask: Mask = field(kw_only=True)

    def read_frame(self, row: int) -> StereoFrame:
        """Read one frame. Raises as the base sequence, and CalibrationError."""
        return self._mask_frame(super().read_frame(row))

    def read_left_frame(self, index: int) -> StereoFrame:
        """Read one frame without its right or depth image. Raises as `read_frame`."""
        from topoloc.recordings.recording import read_left_frame

        frame = read_left_frame(self.base, self.indices[index])
        return self._mask_frame(replace(frame, world_from_cam=self.poses[index]))

    def _mask_frame(self, frame: StereoFrame) -> StereoFrame:
        height, width = frame.image.shape[:2]
        camera = frame.camera or UncalibratedCamera.unknown(width, height)
        masked = with_mask(camera, self.mask)
        image = fill_masked(frame.image, self.mask)
        if not isinstance(masked, Camera):
            return replace(frame, image=image)
        rig = frame.rig and replace(frame.rig, left=masked)
        depth = frame.depth and _mask_depth(frame.depth, self.mask, masked)
        return replace(frame, image=image, camera=masked, rig=rig, depth=depth)


def _mask_depth(depth: DepthImage, mask: Mask, camera: Camera) -> DepthImage:
    """Return depth without that of pixels that are left out, if it has the view of the image."""
    height, width = depth.depth.shape
    if depth.camera not in (camera, camera.rescaled(width, height)):
        return depth
    used = scale_mask(mask, width, height) > 0
    return replace(depth, depth=np.where(used, depth.depth, np.float32(np.nan)))
