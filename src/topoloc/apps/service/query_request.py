"""What a request asks: the picture's bytes and what goes with them, read out of a body that may be
anything."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePath

from pydantic import BaseModel, Field
from starlette.datastructures import UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.requests import ClientDisconnect, Request

from topoloc import AtlasError, GeoPositionPrior, Rigid3, TrajectoryError
from topoloc.apps.service.openapi_schemas import CAMERA_EXAMPLES, PRIOR_EXAMPLE
from topoloc.apps.service.request_errors import RequestError
from topoloc.plugin import EncodedImage

_MAX_FIELDS, _MAX_FIELD_BYTES = 8, 20_000
_MAX_MS = 600_000.0


class QueryParameters(BaseModel):
    """What may be said of a picture in the address instead of in the form, whose fields count
    first."""

    camera: str | None = Field(
        None,
        description="as the form's field `camera`",
        max_length=20_000,
        examples=CAMERA_EXAMPLES,
    )
    prior: str | None = Field(
        None, description="as the form's field `prior`", max_length=2_000, examples=[PRIOR_EXAMPLE]
    )
    near: str | None = Field(
        None,
        description="as the form's field `near`",
        max_length=200,
        examples=["50.8775,4.7043,200"],
    )
    max_ms: float | None = Field(
        None, description="milliseconds after which no further pose is tried", gt=0, le=600_000
    )
    name: str | None = Field(None, description="what the answer calls the picture", max_length=200)


@dataclass(frozen=True, eq=False)
class QueryRequest:
    """A picture and what is said of it.

    `camera` is as `query_cameras.parse_camera_field` reads it, None where nothing is said; `prior`
    is world_from_cam; `max_ms` is that of `Localizer.localize`; tiles of atlases that are known to
    lie elsewhere than `near` are not asked.
    """

    picture: EncodedImage
    camera: str | None = None
    prior: Rigid3 | None = None
    max_ms: float | None = None
    near: GeoPositionPrior | None = None


async def read_query_request(request: Request, parameters: QueryParameters) -> QueryRequest:
    """The body, which is a form with the field `image` or the picture itself; what goes with it is
    in the form, or in the address.

    Raises:
        RequestError: neither, or a field that makes no sense.
    """
    fields = {name: str(value) for name, value in parameters.model_dump(exclude_none=True).items()}
    content_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if content_type == "multipart/form-data":
        data, name, more = await _read_form(request)
        fields |= more
    elif content_type == "application/x-www-form-urlencoded":
        raise RequestError(
            415,
            "the body must be a picture (Content-Type: image/...), or a form with the file `image`"
            " (multipart/form-data)",
        )
    else:
        data, name = await read_body(request), f"image.{content_type.partition('/')[2]}"
    name = fields.get("name", name)[:200]
    if not data:
        raise RequestError(400, f"{name}: the picture is empty")
    picture = EncodedImage(name, data, PurePath(name).suffix)
    return QueryRequest(
        picture,
        fields.get("camera"),
        _parse_prior(fields),
        _parse_max_ms(fields),
        _parse_near(fields),
    )


async def read_body(request: Request) -> bytes:
    """All of it. Raises RequestError where the client goes away."""
    try:
        return await request.body()
    except ClientDisconnect:
        raise RequestError(400, "the request ended early") from None


async def _read_form(request: Request) -> tuple[bytes, str, dict[str, str]]:
    """The picture, its name and the other fields."""
    parser = MultiPartParser(
        request.headers,
        request.stream(),
        max_files=1,
        max_fields=len(QueryParameters.model_fields) + 4,
        max_part_size=_MAX_FIELD_BYTES,
    )
    parser.spool_max_size = (
        2**40
    )  # nothing is written to disk: the whole request is of bounded size
    try:
        form = await parser.parse()
    except (MultiPartException, KeyError, UnicodeDecodeError) as error:
        raise RequestError(
            400, f"the form cannot be read: {getattr(error, 'message', None) or 'it is malformed'}"
        ) from None
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
    raise RequestError(400, "the form has no file called `image`, or ends before it is complete")


def _parse_prior(fields: Mapping[str, str]) -> Rigid3 | None:
    if "prior" not in fields:
        return None
    try:
        return Rigid3.from_json(fields["prior"], "prior")
    except TrajectoryError as error:
        raise RequestError(422, str(error)) from None


def _parse_near(fields: Mapping[str, str]) -> GeoPositionPrior | None:
    try:
        return GeoPositionPrior.parse(fields["near"]) if "near" in fields else None
    except AtlasError as error:
        raise RequestError(422, f"near: {error}") from None


def _parse_max_ms(fields: Mapping[str, str]) -> float | None:
    if "max_ms" not in fields:
        return None
    try:
        max_ms = float(fields["max_ms"])
    except ValueError:
        max_ms = math.nan
    if not 0.0 < max_ms <= _MAX_MS:
        raise RequestError(422, f"max_ms: above 0 and at most {_MAX_MS:g} milliseconds")
    return max_ms
