"""A camera nobody has calibrated: its picture's size, and a range that its focal length lies in."""

from __future__ import annotations

import math
from dataclasses import dataclass

from topoloc.errors import CalibrationError
from topoloc.geometry.camera import Camera

# Of the longer side: fields of view of 103 to 19 degrees along it, from the wide lens of a
# telephone to its long one.
MIN_FOCAL, MAX_FOCAL = 0.4, 3.0
# What a focal length written into a picture's file may be wrong by: it is rounded, and focusing and
# stabilisation change it.
FOCAL_GUESS_TOLERANCE = 1.15


@dataclass(frozen=True)
class UncalibratedCamera:
    """Pinhole, square pixels, principal point in the middle; the focal length (pixels) between
    these two.

    Raises:
        CalibrationError: no positive size, or no range of positive lengths.
    """

    width: int
    height: int
    min_focal: float
    max_focal: float

    def __post_init__(self) -> None:
        if (
            self.width < 1
            or self.height < 1
            or not 0.0 < self.min_focal <= self.max_focal < math.inf
        ):
            size = f"{self.width}x{self.height}"
            raise CalibrationError(
                f"a camera needs a size and a range of focal lengths, not {size}, f ="
                f" {self.min_focal:g} to {self.max_focal:g}"
            )

    @staticmethod
    def unknown(width: int, height: int) -> UncalibratedCamera:
        """Any usual lens."""
        side = max(width, height)
        return UncalibratedCamera(width, height, MIN_FOCAL * side, MAX_FOCAL * side)

    @staticmethod
    def from_focal_guess(width: int, height: int, focal: float) -> UncalibratedCamera:
        """A focal length (pixels) that is about right, such as that of a picture's EXIF data."""
        return UncalibratedCamera(
            width, height, focal / FOCAL_GUESS_TOLERANCE, focal * FOCAL_GUESS_TOLERANCE
        )

    def with_focal(self, focal: float) -> Camera:
        """The pinhole camera of this focal length (pixels)."""
        return Camera.pinhole(
            self.width, self.height, focal, focal, (self.width - 1) / 2, (self.height - 1) / 2
        )

    def rescaled(self, width: int, height: int) -> UncalibratedCamera:
        """The same camera for its image resized to width x height."""
        scale = math.sqrt(width * height / (self.width * self.height))
        return UncalibratedCamera(width, height, self.min_focal * scale, self.max_focal * scale)


def nominal_camera(camera: Camera | UncalibratedCamera) -> Camera:
    """The camera, of a rough one that with the focal length in the middle of its range."""
    return (
        camera.with_focal(math.sqrt(camera.min_focal * camera.max_focal))
        if isinstance(camera, UncalibratedCamera)
        else camera
    )
