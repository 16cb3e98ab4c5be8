"""POST /localize/geopose: the OSCP GeoPose Protocol, by all maps and atlases that know their place
on earth."""

from __future__ import annotations

import math
import time
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Query, Request
from fastapi.responses import JSONResponse, Response

from topoloc.apps.service.answers import decoded_picture
from topoloc.apps.service.asked import read_body
from topoloc.apps.service.documents import resolved
from topoloc.apps.service.geopose_messages import (
    EXAMPLE,
    MEDIA_TYPE,
    CameraReading,
    GeoPoseError,
    GeoPoseReply,
    GeoPoseRequest,
    camera_json,
    check_version,
    picture_of,
    read_request,
    reply_to,
    size_of,
)
from topoloc.apps.service.query_cameras import camera_named, camera_of_json
from topoloc.apps.service.refusals import Refusal
from topoloc.apps.service.state import Service, service_of
from topoloc.geometry.camera import Camera
from topoloc.geometry.geodesy import Georeference
from topoloc.geometry.rough_camera import RoughCamera
from topoloc.localization.result import Localization, NotLocalized
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import Image
from topoloc.recordings.pictures import PictureBytes

router = APIRouter()
_CONTRADICTION_M = 10.0
_REFUSED = {
    400: "no such request, or of another version",
    404: "not localized: why",
    409: "no map knows its place on earth",
}
_REFUSED |= {
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
                "schema": resolved(GeoPoseRequest.model_json_schema()),
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
        status: {"model": GeoPoseError, "description": text} for status, text in _REFUSED.items()
    },
    openapi_extra=_BODY,
)
async def localize_geopose(request: Request, only: MapOnly = None) -> Response:
    """Where on earth was this picture taken? The camera as a body, x forward, y left, z up, in
    east-north-up."""
    service = service_of(request)
    try:
        check_version(request.headers.get("accept", ""))
        body = await read_body(request)
        reply, results = await service.work(request, lambda: _replied(service, body, only))
    except Refusal as refusal:
        return _refused(request, refusal)
    for name, result in results.items():
        service.count(request, name, result)
    if reply is None:
        return _not_localized(request, results)
    return JSONResponse(
        reply.model_dump(), media_type=f"{MEDIA_TYPE};version={_version_of(request)}"
    )


def _replied(
    service: Service, body: bytes, only: str | None
) -> tuple[GeoPoseReply | None, dict[str, Localization | NotLocalized]]:
    """The work of a request: the answer of each map, and of each atlas; and the reply where they
    agree on one place."""
    asked = read_request(body)
    reading = asked.camera_reading()
    picture = picture_of(reading)
    image = (
        decoded_picture(picture, service.answerer.max_pixels)
        if isinstance(picture, PictureBytes)
        else picture
    )
    localizers = [] if only is not None else service.answerer.atlases.localizers()
    tiles = {tile_id for localizer in localizers for tile_id in localizer.atlas.manifest.by_id}
    results, georeferences = dict[str, Localization | NotLocalized](), dict[str, Georeference]()
    for name in (
        [only] if only is not None else [name for name in service.maps.names() if name not in tiles]
    ):
        with service.maps.lent(name) as opened:
            topomap = opened.localizer.topomap
            if topomap.georeference is not None:
                camera = _camera_of(reading, picture, image, topomap)
                results[name] = opened.localizer.localize(
                    image, camera, max_ms=service.answerer.max_ms
                )
                georeferences[name] = topomap.georeference
    near = asked.near(service.config.geolocation_m)
    for localizer in localizers:
        manifest = localizer.atlas.manifest
        known = {
            tile.tile_id: place
            for tile in manifest.tiles
            if (place := manifest.georeference_of(tile)) is not None
        }
        if known:
            camera = _camera_of(reading, picture, image, None)
            result = localizer.near(near, placed_only=True).localize(
                image, camera, max_ms=service.answerer.max_ms
            )
            results[result.provenance.tile or ""] = result
            georeferences |= known
    if not results:
        raise Refusal(
            409, "no map here knows where on earth it lies; `topoloc georeference` tells it"
        )
    found = {name: result for name, result in results.items() if isinstance(result, Localization)}
    best = _agreed(found)
    if best is None:
        return None, results
    return reply_to(asked, found[best], georeferences[best], 1e3 * time.time()), results


def _camera_of(
    reading: CameraReading,
    picture: PictureBytes | Image,
    image: Image,
    topomap: TopoMetricMap | None,
) -> Camera | RoughCamera:
    """What the request says of the camera, else the picture's file, else any usual lens."""
    height, width = image.shape[:2]
    told = camera_json(reading)
    if told is None and isinstance(picture, PictureBytes):
        return camera_named(None, picture, (width, height), topomap)
    if told is None:
        return RoughCamera.unknown(width, height)
    told_width, told_height = size_of(reading) or (width, height)
    camera = camera_of_json(told, told_width, told_height)
    if abs(told_width * height - told_height * width) > max(told_width, told_height):
        raise Refusal(
            400, f"the picture is {width}x{height}, its reading says {told_width}x{told_height}"
        )
    return (
        camera if (told_width, told_height) == (width, height) else camera.rescaled(width, height)
    )


def _agreed(found: dict[str, Localization]) -> str | None:
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
        if np.linalg.norm(place - ecef[best]) > _CONTRADICTION_M + 3.0 * sigmas:
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


def _refused(request: Request, refusal: Refusal) -> JSONResponse:
    """The protocol knows 400 for all that a request can have wrong."""
    status = 400 if refusal.status in (415, 422) else refusal.status
    return JSONResponse(
        {"ERROR": refusal.text, "request_id": request.scope["request_id"]}, status, refusal.headers
    )


def _version_of(request: Request) -> str:
    return "1.0" if "version=1" in request.headers.get("accept", "") else "2.0"
