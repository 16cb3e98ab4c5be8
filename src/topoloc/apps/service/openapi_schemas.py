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
_REFERENCE = "#/components/schemas/{model}"
_TAGS = [
    {"name": "localization", "description": "Poses of single images."},
    {"name": "streams", "description": "Poses of successive images."},
    {"name": "geopose", "description": "The OSCP GeoPose Protocol."},
    {"name": "discovery", "description": "Maps of a region, by SpatialDDS 1.6."},
    {"name": "maps", "description": "What maps hold."},
    {"name": "notes", "description": "Texts at places of a map."},
    {"name": "service", "description": "Health, features and counters."},
]
OBJECT_RESPONSE: dict[int | str, dict[str, Any]] = {
    200: {"content": {"application/json": {"schema": {"type": "object"}}}}
}
PUBLIC: dict[str, Any] = {"security": []}
"""Of a route that takes no token."""
_ERROR_DESCRIPTIONS = {
    400: "an invalid request, no image or a damaged one, or an unreadable form",
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
    """Return the OpenAPI response 200 with one localization result."""
    return named_response("Result", description)


def named_response(name: str, description: str) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI response 200 with a schema of `complete_document`."""
    schema = {"$ref": _REFERENCE.format(model=name)}
    return {200: {"description": description, "content": {"application/json": {"schema": schema}}}}


def request_body(kind: type[BaseModel], example: Any) -> dict[str, Any]:
    """Return the OpenAPI request body of JSON of this kind. `complete_document` adds its parts."""
    schema = kind.model_json_schema(ref_template=_REFERENCE)
    parts = schema.pop("$defs", {})
    content = {"application/json": {"schema": schema, "example": example}}
    return {"requestBody": {"required": True, "content": content}, "x-parts": parts}


def complete_document(document: dict[str, Any]) -> dict[str, Any]:
    """Add the schemas of results and requests and the bearer token to an OpenAPI document."""
    parts = document["components"]
    for methods in document["paths"].values():
        for operation in methods.values():
            parts["schemas"] |= operation.pop("x-parts", {})
    parts["schemas"] |= _result_schemas()
    about = "content of the service's `--token-file`; a service without one takes any request"
    parts["securitySchemes"] = {
        "bearer": {"type": "http", "scheme": "bearer", "description": about}
    }
    return document | {"security": [{"bearer": []}, {}], "tags": _TAGS}


def _result_schemas() -> dict[str, Any]:
    """Return result.schema.json as named schemas. Two objects stand for its conditions, and a
    boolean for its constant: generators of clients fail at these."""
    file = resources.files("topoloc.localization").joinpath("result.schema.json")
    text = file.read_text(encoding="utf-8").replace('"const": false', '"type": "boolean"')
    names = {name: name.title().replace("pose", "Pose") for name in json.loads(text)["$defs"]}
    for name, shown in names.items():
        text = text.replace(f"#/$defs/{name}", _REFERENCE.format(model=shown))
    whole = json.loads(text)
    schemas = {names[name]: schema for name, schema in whole["$defs"].items()}
    for name, kind, is_localized in (("Localized", "then", True), ("NotLocalized", "else", False)):
        own = {key: value for key, value in whole[kind]["properties"].items() if value}
        flag = {"localized": {"type": "boolean", "const": is_localized}}
        schemas[name] = {
            "type": "object",
            "required": whole["required"] + whole[kind]["required"],
            "properties": whole["properties"] | flag | own,
        }
    schemas["NotLocalized"]["examples"] = [_REFUSED_EXAMPLE]
    kinds = [{"$ref": _REFERENCE.format(model=name)} for name in ("Localized", "NotLocalized")]
    schemas["Result"] = {"description": whole["description"], "oneOf": kinds}
    return schemas | _result_of_maps()


def _result_of_maps() -> dict[str, Any]:
    """Return the schemas of the results of all maps."""

    def strict(**properties: Any) -> dict[str, Any]:
        return {"type": "object", "required": list(properties), "properties": properties}

    text, rows = {"type": "string"}, {"$ref": _REFERENCE.format(model="MapResult")}
    only = {"type": ["string", "null"], "description": "the only map with a pose"}
    answers = {"type": "array", "items": rows}
    failed = {"type": "array", "items": strict(map=text, error=text)}
    named = {"query": text, "localized": {"type": "boolean"}, "map": only}
    whole = strict(**named, answers=answers, failed=failed)
    row = strict(map=text, result={"$ref": _REFERENCE.format(model="Result")})
    return {"ResultOfMaps": whole, "MapResult": row}
