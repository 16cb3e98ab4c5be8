"""The camera that a request names.

Nothing (what EXIF says of the focal length, else any usual lens), ``exif`` (the same), ``unknown``,
``map``, ``fx,fy,cx,cy`` in pixels, or a JSON object: parameters by name as in camera.json, or
COLMAP's `model` and `params` in its own convention, where the centre of the top-left pixel is (0.5,
0.5). Files of the server are none.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from topoloc import CalibrationError, Camera, TopoMetricMap, UncalibratedCamera
from topoloc.apps.query_camera import parse_camera_option
from topoloc.apps.service.query_request import parse_json
from topoloc.plugin import EncodedImage, exif_focal_length

_MAX_PARAMS = 20


def parse_camera_field(
    text: str | None, picture: EncodedImage, size: tuple[int, int], topomap: TopoMetricMap | None
) -> Camera | UncalibratedCamera:
    """The camera of a picture of this width and height (pixels); `map` only where one map is asked.

    Raises:
        CalibrationError, QueryError: it is none, or of another picture.
        RequestError: what looks like JSON is none.
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
        return camera_from_json(parse_json(text, "camera"), width, height)
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
    if not isinstance(data, Mapping):
        raise CalibrationError("camera: a JSON object is expected")
    sized: dict[str, Any] = {"width": width, "height": height, **data}
    if "params" not in sized:
        return Camera.from_json(sized)
    params, size = sized["params"], (sized["width"], sized["height"])
    if (
        not isinstance(params, list)
        or len(params) > _MAX_PARAMS
        or not all(_is_number(value) for value in [*params, *size])
    ):
        raise CalibrationError("camera: params must be a list of numbers, width and height numbers")
    return Camera.from_colmap(
        str(sized.get("model", "PINHOLE")), int(size[0]), int(size[1]), tuple(map(float, params))
    )


def _is_number(value: Any) -> bool:
    """One that fits into the bounds of a camera; NaN and the infinite are none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e9
