"""Read focal length and place from the EXIF data of images."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from PIL import ExifTags

from topoloc.errors import GeoreferenceError, UnreadableImageError
from topoloc.geometry.geodesy import GeoPoint
from topoloc.recordings.image_io import DAMAGE_ERRORS, EncodedImage, open_image

_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0}  # inch, centimetre, millimetre
_DIAGONAL_35MM = math.hypot(36.0, 24.0)


def exif_focal_length(path: Path | EncodedImage, width: int, height: int) -> float | None:
    """Return the focal length in pixels from EXIF data, for an image of this size. Return None if
    the data is not usable.

    The focal length equivalent on 35 mm film is used first, relative to the image's diagonal. The
    second choice is the focal length in millimetres with the sensor's resolution (EXIF 2.32, JEITA
    CP-3451).
    """
    try:
        with open_image(path) as picture:
            found = picture.getexif().get_ifd(ExifTags.IFD.Exif)
            tags = {tag: _exif_number(found.get(tag)) for tag in ExifTags.Base}
    except (UnreadableImageError, *DAMAGE_ERRORS):
        return None
    focal = tags[ExifTags.Base.FocalLengthIn35mmFilm] * math.hypot(width, height) / _DIAGONAL_35MM
    if not focal > 0.0:
        mm_a_unit = _MM_PER_UNIT.get(int(tags[ExifTags.Base.FocalPlaneResolutionUnit]), 25.4)
        exif_width = tags[ExifTags.Base.ExifImageWidth]
        # The original width, before rotation.
        scale = max(width, height) / exif_width if exif_width > 0.0 else 1.0
        pixels_per_unit = tags[ExifTags.Base.FocalPlaneXResolution]
        focal = tags[ExifTags.Base.FocalLength] * pixels_per_unit / mm_a_unit * scale
    side = max(width, height)
    return focal if 0.1 * side < focal < 50.0 * side else None


def exif_place(path: Path | EncodedImage) -> GeoPoint | None:
    """Return the place on earth by EXIF data, at height 0 without one. None if there is no usable
    place."""
    try:
        with open_image(path) as picture:
            tags = picture.getexif().get_ifd(ExifTags.IFD.GPSInfo)
        lat, lon = (
            sum(_exif_number(part) / 60.0**k for k, part in enumerate(tags[name]))
            * (-1.0 if str(tags[sign]).strip() in ("S", "W") else 1.0)
            for name, sign in (
                (ExifTags.GPS.GPSLatitude, ExifTags.GPS.GPSLatitudeRef),
                (ExifTags.GPS.GPSLongitude, ExifTags.GPS.GPSLongitudeRef),
            )
        )
        is_below = tags.get(ExifTags.GPS.GPSAltitudeRef) in (1, b"\x01")
        height = _exif_number(tags.get(ExifTags.GPS.GPSAltitude))
        place = GeoPoint(lat, lon, -height if is_below else height)
    except (KeyError, TypeError, GeoreferenceError, UnreadableImageError, *DAMAGE_ERRORS):
        return None
    return place if (lat, lon) != (0.0, 0.0) else None


def _exif_number(value: Any) -> float:
    """Return an EXIF tag as a number, or 0 if it is not a finite number."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return 0.0
    return number if math.isfinite(number) else 0.0
