"""The camera that a request names.

Nothing (what EXIF says of the focal length, else any usual lens), ``exif`` (the same), ``unknown``,
``map``, ``fx,fy,cx,cy`` in pixels, or a JSON object: parameters by name as in camera.json, or
COLMAP's `model` and `params` in its own convention, where the centre of the top-left pixel is (0.5,
0.5). Files of the server are none.
"""

from __future__ import annotations

from typing import Annotated, Any

from msgspec import Meta, Struct

from topoloc import CalibrationError, Camera, TopoMetricMap, UncalibratedCamera
from topoloc.apps.query_camera import parse_camera_option
from topoloc.plugin import EncodedImage, decode_json, exif_focal_length


def parse_camera_field(
    text: str | None, picture: EncodedImage, size: tuple[int, int], topomap: TopoMetricMap | None
) -> Camera | UncalibratedCamera:
    """The camera of a picture of this width and height (pixels); `map` only where one map is asked.

    Raises:
        CalibrationError, QueryError: it is none, or of another picture.
    """
    width, height = size
    text = (text or "exif").strip()
    if text == "exif":
        focal = exif_focal_length(picture, width, height)
        return (
            UncalibratedCamera.unknown(width, height)
            if focal is None
            else UncalibratedCamera.from_focal_guess(width, height, focal)
        )
    if text == "unknown" or (text == "map" and topomap is not None):
        return parse_camera_option(text, topomap, allow_files=False)(width, height)
    if text.startswith("{"):
        return camera_from_json(text, width, height)
    if "," in text:
        return parse_camera_option(text, None, allow_files=False)(width, height)
    raise CalibrationError(
        f"camera {text[:40]!r}: exif, unknown, map, fx,fy,cx,cy or a JSON object is expected"
    )


def camera_from_json(data: Any, width: int, height: int) -> Camera:
    """The camera of an object; its size is the picture's where it names none.

    Raises:
        CalibrationError: it is no camera.
    """
    named = decode_json(data, dict[str, Any], CalibrationError, "camera")
    sized = {"width": width, "height": height, **named}
    if "params" not in sized:
        return Camera.from_json(sized)
    camera = decode_json(sized, _ColmapCamera, CalibrationError, "camera")
    size = int(camera.width), int(camera.height)
    return Camera.from_colmap(camera.model, *size, tuple(camera.params))


_Number = Annotated[float, Meta(gt=-1e9, lt=1e9)]


class _ColmapCamera(Struct, frozen=True):
    width: _Number
    height: _Number
    params: Annotated[list[_Number], Meta(max_length=20)]
    model: str = "PINHOLE"
