"""Parse a query from an HTTP request: the image, its camera and the other parameters."""

from __future__ import annotations

import re
import threading
from dataclasses import dataclass, field
from pathlib import PurePath
from typing import Annotated, Any

from msgspec import Meta, Struct
from starlette.datastructures import UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.requests import ClientDisconnect, Request

from topoloc import (
    AtlasError,
    CalibrationError,
    Camera,
    GeoPositionPrior,
    Rigid3,
    TopoMetricMap,
    TrajectoryError,
    UncalibratedCamera,
)
from topoloc.apps.core_names import exif_focal_length
from topoloc.apps.query_camera import parse_camera_option
from topoloc.apps.service.openapi_schemas import QueryParameters
from topoloc.apps.service.request_errors import RequestError
from topoloc.plugin import EncodedImage, decode_json

_MAX_FIELD_BYTES = 20_000
# how JPEG, PNG, WebP, TIFF, BMP and HEIC begin in base64, also that of addresses
_BASE64 = re.compile(rb"data:image/|[/_]9j[/_]|iVBORw0KGg|UklGR|SUkq|TU0AK|Qk[0-3]|AAAA..Z0eX")
_REMEDY = (
    "send the bytes of the image file, not base64: as the body (Content-Type: image/...), or as the"
    " file `image` of a form (with a filename)"
)
_MAX_MS = 600_000.0
_MAX_MS_FAULT = f"max_ms: above 0 and at most {_MAX_MS:g} milliseconds"


@dataclass(frozen=True, eq=False)
class QueryRequest:
    """An image and its parameters.

    Attributes:
        camera: text for `parse_camera_field`; None if the request names no camera.
        prior: world_from_cam.
        max_ms: time limit of `Localizer.localize`.
        near: tiles of atlases that lie further away are skipped.
        stop: is set when nobody waits for the result any more. The search then ends.
    """

    picture: EncodedImage
    camera: str | None = None
    prior: Rigid3 | None = None
    max_ms: float | None = None
    near: GeoPositionPrior | None = None
    stop: threading.Event = field(default_factory=threading.Event)


async def read_query_request(request: Request, parameters: QueryParameters) -> QueryRequest:
    """Read a query. The body is an image, or a form with the field `image`. Raises RequestError:
    the body is neither, or a parameter is invalid."""
    fields = {name: str(value) for name, value in parameters.model_dump(exclude_none=True).items()}
    content_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if content_type == "multipart/form-data":
        data, name, more = await _read_form(request)
        fields |= more
    elif content_type == "application/x-www-form-urlencoded":
        raise RequestError(
            415,
            "the body must be an image (Content-Type: image/...), or a form with the file `image`"
            " (multipart/form-data)",
        )
    else:
        data, name = await read_body(request), f"image.{content_type.partition('/')[2]}"
    name = fields.get("name", name)[:200]
    if not data:
        raise RequestError(400, f"{name}: the image is empty")
    if kind := _find_text_kind(data):
        raise RequestError(415, f"{name}: {kind}, not an image; {_REMEDY}")
    return QueryRequest(
        EncodedImage(name, data, PurePath(name).suffix),
        fields.get("camera"),
        *_parse_parameters(fields),
    )


def _find_text_kind(data: bytes) -> str | None:
    """Return JSON or base64 if the body is one of these, else None. No image file begins so."""
    start = data[:200].lstrip(b" \t\r\n\"'")
    if start.startswith((b"{", b"[")):
        return "JSON"
    return "base64" if _BASE64.match(start) else None


async def read_body(request: Request) -> bytes:
    """Return the whole body. Raises RequestError if the client disconnects."""
    try:
        return await request.body()
    except ClientDisconnect:
        raise RequestError(400, "the request ended early") from None


async def _read_form(request: Request) -> tuple[bytes, str, dict[str, str]]:
    """Return the image, its name and the other fields."""
    parser = MultiPartParser(
        request.headers,
        request.stream(),
        max_files=1,
        max_fields=len(QueryParameters.model_fields) + 4,
        max_part_size=_MAX_FIELD_BYTES,
    )
    parser.spool_max_size = 2**40  # never to disk: the middleware limits the request's size
    try:
        form = await parser.parse()
    except (MultiPartException, KeyError, UnicodeDecodeError) as error:
        reason = getattr(error, "message", None) or "it is malformed"
        if "exceeded maximum size" in reason:
            reason = f"a field of text has more than {_MAX_FIELD_BYTES} bytes; {_REMEDY}"
        raise RequestError(400, f"the form cannot be read: {reason}") from None
    except ClientDisconnect:
        raise RequestError(400, "the request ended early") from None
    fields = {
        name: value
        for name, value in form.items()
        if name in QueryParameters.model_fields and isinstance(value, str)
    }
    picture = form.get("image")
    if isinstance(picture, UploadFile):
        return await picture.read(), picture.filename or "image", fields
    if isinstance(picture, str):
        raise RequestError(400, f"the field `image` of the form is text; {_REMEDY}")
    raise RequestError(400, "the form has no file called `image`, or ends before it is complete")


def _parse_parameters(
    fields: dict[str, str],
) -> tuple[Rigid3 | None, float | None, GeoPositionPrior | None]:
    """Return the prior, the time limit and the position of a query. Raises RequestError."""
    try:
        prior = Rigid3.from_json(fields["prior"], "prior") if "prior" in fields else None
        max_ms = float(fields["max_ms"]) if "max_ms" in fields else None
        near = GeoPositionPrior.parse(fields["near"]) if "near" in fields else None
    except TrajectoryError as error:
        raise RequestError(422, str(error)) from None
    except AtlasError as error:
        raise RequestError(422, f"near: {error}") from None
    except ValueError:
        raise RequestError(422, _MAX_MS_FAULT) from None
    if max_ms is not None and not 0.0 < max_ms <= _MAX_MS:
        raise RequestError(422, _MAX_MS_FAULT)
    return prior, max_ms, near


def parse_camera_field(
    text: str | None, picture: EncodedImage, size: tuple[int, int], topomap: TopoMetricMap | None
) -> Camera | UncalibratedCamera:
    """Return the camera of an image of this width and height (pixels). Server files are not read.
    Raises CalibrationError, QueryError: the camera is invalid or does not fit the image.

    Args:
        text: ``exif`` (the default), ``unknown``, ``map``, ``fx,fy,cx,cy``, or a JSON object.
        topomap: the queried map, for ``map``; None if several maps are queried.
    """
    width, height = size
    text = (text or "exif").strip()
    if text == "exif":
        focal = exif_focal_length(picture, width, height)
        return UncalibratedCamera.from_focal_guess(width, height, focal)
    if text.startswith("{"):
        return camera_from_json(text, width, height)
    if text == "unknown" or "," in text or (text == "map" and topomap is not None):
        return parse_camera_option(text, topomap, allow_files=False)(width, height)
    raise CalibrationError(
        f"camera {text[:40]!r}: exif, unknown, map, fx,fy,cx,cy or a JSON object is expected"
    )


def camera_from_json(data: Any, width: int, height: int) -> Camera:
    """Convert a JSON camera: parameters as in camera.json, or `model` and `params` of COLMAP.

    COLMAP's centre of the top-left pixel is (0.5, 0.5). The default size is that of the image.
    Raises CalibrationError: the camera is invalid.
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
