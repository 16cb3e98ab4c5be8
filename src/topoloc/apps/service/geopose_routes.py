"""POST /localize/geopose: the OSCP GeoPose Protocol, by all maps and atlases that know their place
on earth."""

from __future__ import annotations

import math
import time
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Query, Request
from fastapi.responses import JSONResponse, Response

from topoloc import (
    Camera,
    Georeference,
    Image,
    Localization,
    NotLocalized,
    TopoMetricMap,
    UncalibratedCamera,
)
from topoloc.apps.service.geopose_messages import (
    EXAMPLE,
    MEDIA_TYPE,
    CameraReading,
    GeoPoseError,
    GeoPoseReply,
    GeoPoseRequest,
    camera_to_json,
    check_version,
    create_reply,
    read_image_bytes,
    read_image_size,
    read_request,
)
from topoloc.apps.service.openapi_schemas import resolve_references
from topoloc.apps.service.query_cameras import camera_from_json, parse_camera_field
from topoloc.apps.service.query_handler import decode_image
from topoloc.apps.service.query_request import read_body
from topoloc.apps.service.request_errors import RequestError
from topoloc.apps.service.state import Service, get_service
from topoloc.plugin import EncodedImage

router = APIRouter()
_MAX_DISAGREEMENT_M = 10.0
_ERRORS = {
    400: "no such request, or of another version",
    404: "not localized: why",
    409: "no map knows its place on earth",
}
_ERRORS |= {
    401: "no token",
    408: "too slow",
    413: "too large",
    429: "too many wait",
    503: "the service failed",
}
_BODY = {
    "requestBody": {
        "required": True,
        "content": {
            "application/json": {
                "schema": resolve_references(GeoPoseRequest.model_json_schema()),
                "example": EXAMPLE,
            }
        },
    }
}
MapOnly = Annotated[
    str | None, Query(alias="map", description="ask this map alone", max_length=200)
]


@router.get("/localize/geopose")
async def geopose_lives() -> dict[str, str]:
    """As the protocol's reference server answers."""
    return {"status": "running"}


@router.post(
    "/localize/geopose",
    response_model=GeoPoseReply,
    responses={
        status: {"model": GeoPoseError, "description": text} for status, text in _ERRORS.items()
    },
    openapi_extra=_BODY,
)
async def localize_geopose(request: Request, only: MapOnly = None) -> Response:
    """Where on earth was this picture taken? The camera as a body, x forward, y left, z up, in
    east-north-up."""
    service = get_service(request)
    try:
        check_version(request.headers.get("accept", ""))
        body = await read_body(request)
        reply, results = await service.run_job(
            request, lambda: _localize_and_reply(service, body, only)
        )
    except RequestError as refusal:
        return _error_response(request, refusal)
    for name, result in results.items():
        service.count(request, name, result)
    if reply is None:
        return _not_localized(request, results)
    return JSONResponse(
        reply.model_dump(), media_type=f"{MEDIA_TYPE};version={_parse_version(request)}"
    )


def _localize_and_reply(
    service: Service, body: bytes, only: str | None
) -> tuple[GeoPoseReply | None, dict[str, Localization | NotLocalized]]:
    """The work of a request: the answer of each map, and of each atlas; and the reply where they
    agree on one place."""
    asked = read_request(body)
    reading = asked.camera_reading()
    picture = read_image_bytes(reading)
    image = (
        decode_image(picture, service.query_handler.max_pixels)
        if isinstance(picture, EncodedImage)
        else picture
    )
    atlases = [] if only is not None else service.query_handler.atlases.opened()
    tiles = {tile_id for _, localizer in atlases for tile_id in localizer.tile_ids}
    results, georeferences = dict[str, Localization | NotLocalized](), dict[str, Georeference]()
    for name in (
        [only] if only is not None else [name for name in service.maps.names() if name not in tiles]
    ):
        with service.maps.use_map(name) as opened:
            topomap = opened.content.topomap
            if topomap.georeference is not None:
                camera = _select_camera(reading, picture, image, topomap)
                results[name] = opened.content.localize(
                    image, camera, max_ms=service.query_handler.max_ms
                )
                georeferences[name] = topomap.georeference
    near = asked.near(service.config.geolocation_m)
    for atlas, localizer in atlases:
        known = {
            tile.tile_id: place
            for tile in atlas.manifest.tiles
            if (place := atlas.manifest.georeference_of(tile)) is not None
        }
        if known:
            camera = _select_camera(reading, picture, image, None)
            result = localizer.near(near, georeferenced_only=True).localize(
                image, camera, max_ms=service.query_handler.max_ms
            )
            results[result.provenance.tile or ""] = result
            georeferences |= known
    if not results:
        raise RequestError(
            409, "no map here knows where on earth it lies; `topoloc georeference` tells it"
        )
    found = {name: result for name, result in results.items() if isinstance(result, Localization)}
    best = _select_agreeing_map(found)
    if best is None:
        return None, results
    return create_reply(asked, found[best], georeferences[best], 1e3 * time.time()), results


def _select_camera(
    reading: CameraReading,
    picture: EncodedImage | Image,
    image: Image,
    topomap: TopoMetricMap | None,
) -> Camera | UncalibratedCamera:
    """What the request says of the camera, else the picture's file, else any usual lens."""
    height, width = image.shape[:2]
    told = camera_to_json(reading)
    if told is None and isinstance(picture, EncodedImage):
        return parse_camera_field(None, picture, (width, height), topomap)
    if told is None:
        return UncalibratedCamera.unknown(width, height)
    told_width, told_height = read_image_size(reading) or (width, height)
    camera = camera_from_json(told, told_width, told_height)
    if abs(told_width * height - told_height * width) > max(told_width, told_height):
        raise RequestError(
            400, f"the picture is {width}x{height}, its reading says {told_width}x{told_height}"
        )
    return (
        camera if (told_width, told_height) == (width, height) else camera.rescaled(width, height)
    )


def _select_agreeing_map(found: dict[str, Localization]) -> str | None:
    """The map whose pose has most for it; None where another one says that it was far from
    there."""
    if not found:
        return None
    best = max(found, key=lambda name: found[name].probability)
    ecef = {
        name: result.geopose.position.ecef()
        for name, result in found.items()
        if result.geopose is not None
    }
    for name, place in ecef.items():
        sigmas = math.hypot(found[name].position_sigma_m, found[best].position_sigma_m)
        if np.linalg.norm(place - ecef[best]) > _MAX_DISAGREEMENT_M + 3.0 * sigmas:
            return None
    return best


def _not_localized(
    request: Request, results: dict[str, Localization | NotLocalized]
) -> JSONResponse:
    refused = [result for result in results.values() if isinstance(result, NotLocalized)]
    several = len(refused) < len(results)
    reason = "ambiguous" if several else refused[0].reason
    text = (
        "maps place it far apart"
        if several
        else refused[0].detail or refused[0].reason.replace("_", " ")
    )
    return JSONResponse(
        {
            "ERROR": f"not localized: {text}",
            "reason": reason,
            "request_id": request.scope["request_id"],
        },
        404,
    )


def _error_response(request: Request, refusal: RequestError) -> JSONResponse:
    """The protocol knows 400 for all that a request can have wrong."""
    status = 400 if refusal.status in (415, 422) else refusal.status
    return JSONResponse(
        {"ERROR": refusal.text, "request_id": request.scope["request_id"]}, status, refusal.headers
    )


def _parse_version(request: Request) -> str:
    return "1.0" if "version=1" in request.headers.get("accept", "") else "2.0"
