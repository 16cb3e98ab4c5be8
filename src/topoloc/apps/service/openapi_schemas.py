"""OpenAPI schemas that FastAPI does not derive: query images, results and errors."""

from __future__ import annotations

import json
from importlib import resources
from typing import Any

from pydantic import BaseModel, Field


class Error(BaseModel):
    """A refused request: the reason in one sentence, and the id of its line in the log."""

    error: str
    request_id: str


class QueryParameters(BaseModel):
    """Optional parameters of a query image. Form fields take precedence over the URL."""

    camera: str | None = Field(
        None,
        description=(
            "`exif` (focal length of the file, else any common one), `unknown`, `map`,"
            ' `fx,fy,cx,cy` in pixels, a JSON object as camera.json, or COLMAP\'s `{"model":'
            ' "OPENCV", "params": [...]}` (centre of the top-left pixel at 0.5, 0.5)'
        ),
        max_length=20_000,
        examples=[
            "unknown",
            "380,380,319.5,199.5",
            '{"model": "OPENCV", "params": [380, 380, 320, 200, 0.01, 0, 0, 0]}',
        ],
    )
    prior: str | None = Field(
        None,
        description="approximate pose world_from_cam, as in results (JSON)",
        max_length=2_000,
        examples=['{"translation": [0.2, 0.0, 1.4], "quat_wxyz": [1, 0, 0, 0]}'],
    )
    near: str | None = Field(
        None,
        description="`LAT,LON,METRES`: skip tiles of atlases that lie further from this position",
        max_length=200,
        examples=["50.8775,4.7043,200"],
    )
    max_ms: float | None = Field(
        None, description="milliseconds after which no further pose is tried", gt=0, le=600_000
    )
    name: str | None = Field(None, description="name of the image in the result", max_length=200)


_REFUSED_EXAMPLE = {
    "query": "view.jpg",
    "localized": False,
    "reason": "too_few_matches",
    "detail": "",
    "alternatives": [],
    "candidates": [[12, 0.31], [40, 0.29]],
    "num_matches": 9,
    "num_inliers": 0,
    "times_ms": {"features": 14.2, "matching": 8.1, "total": 24.9},
    "map": "47f0700ed2db59ce",
    "version": 1,
    "t_ns": 1700000000000000000,
    "camera": {"model": "PINHOLE", "width": 640, "height": 400}
    | {"fx": 380.0, "fy": 380.0, "cx": 319.5, "cy": 199.5},
    "features": "surf",
}
_FILE = {"type": "string", "format": "binary"}
_IMAGE = _FILE | {"description": "PNG, JPEG, BMP, PNM, TIFF or WebP; HEIC with the extra heic"}
_FORM = {
    "type": "object",
    "required": ["image"],
    "properties": {"image": _IMAGE} | QueryParameters.model_json_schema()["properties"],
}
IMAGE_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {"multipart/form-data": {"schema": _FORM}}
        | {kind: {"schema": _FILE} for kind in ("image/jpeg", "image/png")},
    }
}
_ERROR_DESCRIPTIONS = {
    400: "no image, a damaged image, or an unreadable form",
    401: "the token is missing or wrong",
    403: "the request comes from a page of another site",
    404: "no such map, session or note",
    408: "the request came too slowly",
    409: "the previous image of the stream is still in progress, or no further note can be kept",
    413: "too many bytes or pixels",
    415: "wrong content type of the body",
    422: "invalid camera, prior or number",
    429: "too many requests wait; see Retry-After",
    503: "the map or the worker failed, or the time limit is exceeded",
}


def error_responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI responses of error statuses."""
    return {
        status: {"model": Error, "description": _ERROR_DESCRIPTIONS[status]} for status in statuses
    }


QUERY_ERRORS = error_responses(400, 401, 403, 404, 408, 413, 415, 422, 429, 503)
"""Errors of every route that takes an image."""


def result_response(description: str) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI response 200 with the schema of one localization result."""
    file = resources.files("topoloc.localization").joinpath("result.schema.json")
    schema = resolve_references(json.loads(file.read_text(encoding="utf-8")))
    shown = {name: value for name, value in schema.items() if not name.startswith("$")}
    shown["examples"] = [_REFUSED_EXAMPLE]
    return {200: {"description": description, "content": {"application/json": {"schema": shown}}}}


def resolve_references(schema: dict[str, Any]) -> dict[str, Any]:
    """Return a schema with the references to its own `$defs` replaced by their content."""
    named = schema.get("$defs", {})

    def resolve_value(value: Any) -> Any:
        if isinstance(value, list):
            return [resolve_value(one) for one in value]
        if not isinstance(value, dict):
            return value
        if "$ref" in value:
            return resolve_value(named[value["$ref"].rpartition("/")[2]])
        return {name: resolve_value(one) for name, one in value.items() if name != "$defs"}

    return resolve_value(schema)
