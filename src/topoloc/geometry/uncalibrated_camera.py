"""Describe an uncalibrated camera by the size of its image and a range of focal lengths."""

from __future__ import annotations

import math
from dataclasses import dataclass

from topoloc.errors import CalibrationError
from topoloc.geometry.camera import Camera

# As fractions of the longer side: fields of view of 103 to 19 degrees along it, from the wide lens
# of a phone to its telephoto lens.
MIN_FOCAL, MAX_FOCAL = 0.4, 3.0
# Error factor of a focal length in EXIF data: it is rounded, and focusing and stabilisation change
# it.
FOCAL_GUESS_TOLERANCE = 1.15


@dataclass(frozen=True)
class UncalibratedCamera:
    """Hold a pinhole with square pixels, its principal point in the image centre, and a focal
    length (pixels) between two bounds.

    Raises:
        CalibrationError: the size is not positive, or the range is not one of positive lengths.
    """

    width: int
    height: int
    min_focal: float
    max_focal: float

    def __post_init__(self) -> None:
        is_range = 0.0 < self.min_focal <= self.max_focal < math.inf
        if self.width < 1 or self.height < 1 or not is_range:
            raise CalibrationError(
                "a camera needs a size and a range of focal lengths, not"
                f" {self.width}x{self.height}, f = {self.min_focal:g} to {self.max_focal:g}"
            )

    @staticmethod
    def unknown(width: int, height: int) -> UncalibratedCamera:
        """Return a camera with the range of usual lenses."""
        side = max(width, height)
        return UncalibratedCamera(width, height, MIN_FOCAL * side, MAX_FOCAL * side)

    @staticmethod
    def from_focal_guess(width: int, height: int, focal: float | None) -> UncalibratedCamera:
        """Return a camera with a range around an approximate focal length (pixels), such as that of
        EXIF data. If it is None, return `unknown`."""
        if focal is None:
            return UncalibratedCamera.unknown(width, height)
        return UncalibratedCamera(
            width, height, focal / FOCAL_GUESS_TOLERANCE, focal * FOCAL_GUESS_TOLERANCE
        )

    def with_focal(self, focal: float) -> Camera:
        """Return the pinhole camera of this focal length (pixels)."""
        return Camera.pinhole(
            self.width, self.height, focal, focal, (self.width - 1) / 2, (self.height - 1) / 2
        )

    def rescaled(self, width: int, height: int) -> UncalibratedCamera:
        """Return the camera of the image resized to width x height."""
        scale = math.sqrt(width * height / (self.width * self.height))
        return UncalibratedCamera(width, height, self.min_focal * scale, self.max_focal * scale)


def nominal_camera(camera: Camera | UncalibratedCamera) -> Camera:
    """Return the camera itself. For an uncalibrated camera, return the one with the focal length in
    the (geometric) middle of its range."""
    return (
        camera.with_focal(math.sqrt(camera.min_focal * camera.max_focal))
        if isinstance(camera, UncalibratedCamera)
        else camera
    )
