"""What OpenAPI says beyond what FastAPI finds out by itself: bodies, answers, examples."""

from __future__ import annotations

import json
from importlib import resources
from typing import Any

from pydantic import BaseModel


class Error(BaseModel):
    """Why a request was refused, in one sentence; `request_id` is that of its line in the log."""

    error: str
    request_id: str


_CAMERA = {
    "type": "string",
    "description": (
        "`exif` (what the picture's file says, else any usual lens), `unknown`, `map`,"
        ' `fx,fy,cx,cy` in pixels, a JSON object as camera.json, or COLMAP\'s `{"model": "OPENCV",'
        ' "params": [...]}` (centre of the top-left pixel at 0.5, 0.5)'
    ),
}
_PRIOR = {
    "type": "string",
    "description": "about where the camera is, world_from_cam as results write it (JSON)",
}
_NEAR = {
    "type": "string",
    "description": (
        "`LAT,LON,METRES`: tiles of atlases that are known to lie further from this place on earth"
        " are not asked; maps are"
    ),
}
CAMERA_EXAMPLES = [
    "unknown",
    "380,380,319.5,199.5",
    '{"model": "OPENCV", "params": [380, 380, 320, 200, 0.01, 0, 0, 0]}',
]
PRIOR_EXAMPLE = '{"translation": [0.2, 0.0, 1.4], "quat_wxyz": [1, 0, 0, 0]}'
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
    "camera": {
        "model": "PINHOLE",
        "width": 640,
        "height": 400,
        "fx": 380.0,
        "fy": 380.0,
        "cx": 319.5,
        "cy": 199.5,
    },
    "features": "surf",
}
_FORM = {
    "type": "object",
    "required": ["image"],
    "properties": {
        "image": {
            "type": "string",
            "format": "binary",
            "description": "PNG, JPEG, BMP, PNM, TIFF or WebP; HEIC with the extra heic",
        },
        "camera": _CAMERA,
        "prior": _PRIOR,
        "near": _NEAR,
        "max_ms": {"type": "number", "exclusiveMinimum": 0, "maximum": 600000},
        "name": {"type": "string", "maxLength": 200},
    },
}
IMAGE_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {"schema": _FORM},
            "image/jpeg": {"schema": {"type": "string", "format": "binary"}},
            "image/png": {"schema": {"type": "string", "format": "binary"}},
        },
    }
}
_ERROR_DESCRIPTIONS = {
    400: "no picture, or a damaged one; a form that cannot be read",
    401: "no token, or another one",
    403: "a page of another site asks",
    404: "no such map or session",
    408: "the request came too slowly",
    409: "not in this state of things",
    413: "too many bytes, or too many pixels",
    415: "a body of another kind is expected",
    422: "a camera, a prior or a number that makes no sense",
    429: "too many wait; Retry-After says when to come again",
    503: "the map or the worker failed, or it took too long",
}


def error_responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """These answers, for OpenAPI."""
    return {
        status: {"model": Error, "description": _ERROR_DESCRIPTIONS[status]} for status in statuses
    }


def result_schema() -> dict[str, Any]:
    """That of one result, with what it refers to written out."""
    text = (
        resources.files("topoloc.localization")
        .joinpath("result.schema.json")
        .read_text(encoding="utf-8")
    )
    return {
        name: value
        for name, value in resolve_references(json.loads(text)).items()
        if not name.startswith("$")
    } | {"examples": [_REFUSED_EXAMPLE]}


def resolve_references(schema: dict[str, Any]) -> dict[str, Any]:
    """A schema with what it refers to in its own `$defs` written out."""
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


def success_response(schema: dict[str, Any], description: str) -> dict[int | str, dict[str, Any]]:
    """The answer 200 of this schema, for OpenAPI."""
    return {200: {"description": description, "content": {"application/json": {"schema": schema}}}}
