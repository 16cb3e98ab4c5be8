"""POST /localize/geopose: the OSCP GeoPose Protocol for all georeferenced maps and atlases."""

from __future__ import annotations

import math
import threading
import time
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Query, Request
from fastapi.responses import JSONResponse, Response

from topoloc import (
    Camera,
    GeoPose,
    Georeference,
    Image,
    Localization,
    NotLocalized,
    TopoMetricMap,
    UncalibratedCamera,
)
from topoloc.apps.service.openapi_schemas import error_responses, request_body
from topoloc.apps.service.protocols.geopose_messages import (
    EXAMPLE,
    MEDIA_TYPE,
    ROUTE,
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
from topoloc.apps.service.query_handler import Failures, Results, adapt_camera
from topoloc.apps.service.query_request import camera_from_json, parse_camera_field, read_body
from topoloc.apps.service.request_errors import RequestError
from topoloc.apps.service.state import Service, get_service
from topoloc.plugin import EncodedImage

router = APIRouter(tags=["geopose"])
_MAX_DISAGREEMENT_M = 10.0
_ERRORS = {
    400: "invalid request, or an unknown version",
    404: "not localized: reason",
    408: "the request came too slowly",
    409: "no map is georeferenced",
    413: "the request is too large",
    429: "too many requests wait",
    503: "the service failed",
}
MapOnly = Annotated[str | None, Query(alias="map", description="use this map only", max_length=200)]


@router.get(ROUTE, responses=error_responses(401, 403))
async def get_geopose_state() -> dict[str, str]:
    """Return the state, as the protocol's reference server does."""
    return {"status": "running"}


@router.post(
    ROUTE,
    response_model=GeoPoseReply,
    responses={
        status: {"model": GeoPoseError, "description": text} for status, text in _ERRORS.items()
    }
    | error_responses(401, 403, 422),
    openapi_extra=request_body(GeoPoseRequest, EXAMPLE),
)
async def localize_geopose(request: Request, only: MapOnly = None) -> Response:
    """Localize an image on earth. The body frame of the camera is x forward, y left, z up; the pose
    is in east-north-up."""
    service, accept = get_service(request), request.headers.get("accept", "")
    try:
        check_version(accept)
        body, stop = await read_body(request), threading.Event()
        reply, results = await service.run_job(
            request, lambda: _localize_and_reply(service, body, only, stop), stop
        )
    except RequestError as refusal:  # the protocol has 400 for all faults of a request
        status = 400 if refusal.status in (415, 422) else refusal.status
        return _error_response(request, status, {"ERROR": refusal.text}, refusal.headers)
    for name, result in results.items():
        service.count(request, name, result)
    if reply is None:
        return _error_response(request, 404, _describe_refusal(results))
    version = "1.0" if "version=1" in accept else "2.0"
    return JSONResponse(reply.model_dump(), media_type=f"{MEDIA_TYPE};version={version}")


def _localize_and_reply(
    service: Service, body: bytes, only: str | None, stop: threading.Event
) -> tuple[GeoPoseReply | None, Results]:
    """Return the results of all maps and atlases, and the reply if their poses agree."""
    query = read_request(body)
    reading = query.camera_reading()
    picture, handler = read_image_bytes(reading), service.query_handler
    is_encoded = isinstance(picture, EncodedImage)
    image, size = handler.decoder.decode(picture) if is_encoded else (picture, picture.shape[1::-1])
    atlases = [] if only is not None else handler.atlases.opened()
    tiles = {tile_id for _, localizer in atlases for tile_id in localizer.tile_ids}
    maps = [name for name in service.maps.names() if name not in tiles] if only is None else [only]
    results, failures = Results(), Failures()
    georeferences = dict[str, Georeference]()
    deadline = handler.deadline_of(stop)
    for name in maps:
        with failures.leaving_out(name), service.maps.use_map(name) as opened:
            topomap = opened.content.topomap
            if topomap.georeference is not None:
                camera = adapt_camera(_select_camera(reading, picture, size, topomap), size, image)
                results[name] = opened.content.localize(image, camera, max_ms=deadline)
                georeferences[name] = topomap.georeference
    near = query.near(service.config.geolocation_m)
    for atlas, localizer in atlases:
        manifest = atlas.manifest
        places = {tile.tile_id: manifest.georeference_of(tile) for tile in manifest.tiles}
        known = {tile_id: place for tile_id, place in places.items() if place is not None}
        if known:
            camera = adapt_camera(_select_camera(reading, picture, size, None), size, image)
            nearby = localizer.near(near, georeferenced_only=True)
            result = nearby.localize(image, camera, max_ms=deadline)
            results[result.provenance.tile or ""] = result
            georeferences |= known
    failures.check_any(results)
    if not results:
        raise RequestError(409, "no map is georeferenced; use `topoloc georeference`")
    if (best := _select_agreeing_map(results)) is None:
        return None, results
    name, result, geopose = best
    return create_reply(query, result, geopose, georeferences[name], 1e3 * time.time()), results


def _select_camera(
    reading: CameraReading,
    picture: EncodedImage | Image,
    size: tuple[int, int],
    topomap: TopoMetricMap | None,
) -> Camera | UncalibratedCamera:
    """Return the camera of the request, else that of the EXIF data, else an unknown one, for an
    image of this width and height."""
    width, height = size
    given = camera_to_json(reading)
    if given is None and isinstance(picture, EncodedImage):
        return parse_camera_field(None, picture, (width, height), topomap)
    if given is None:
        return UncalibratedCamera.unknown(width, height)
    given_width, given_height = read_image_size(reading) or (width, height)
    camera = camera_from_json(given, given_width, given_height)
    if abs(given_width * height - given_height * width) > max(given_width, given_height):
        raise RequestError(
            400, f"the image is {width}x{height}, but its reading is {given_width}x{given_height}"
        )
    same_size = (given_width, given_height) == (width, height)
    return camera if same_size else camera.rescaled(width, height)


def _select_agreeing_map(results: Results) -> tuple[str, Localization, GeoPose] | None:
    """Return the most probable pose with its map; None if another pose is far from it."""
    found = [
        (name, result, result.geopose)
        for name, result in results.items()
        if isinstance(result, Localization) and result.geopose is not None
    ]
    if not found:
        return None
    best = max(found, key=lambda one: one[1].probability)
    for _, result, geopose in found:
        sigmas = math.hypot(result.position_sigma_m, best[1].position_sigma_m)
        distance = np.linalg.norm(geopose.position.ecef() - best[2].position.ecef())
        if distance > _MAX_DISAGREEMENT_M + 3.0 * sigmas:
            return None
    return best


def _describe_refusal(results: Results) -> dict[str, str]:
    refused = [result for result in results.values() if isinstance(result, NotLocalized)]
    if len(refused) < len(results):
        return {"ERROR": "not localized: the poses of maps are far apart", "reason": "ambiguous"}
    reason = refused[0].reason
    text = refused[0].detail or reason.replace("_", " ")
    return {"ERROR": f"not localized: {text}", "reason": reason}


def _error_response(
    request: Request, status: int, content: dict[str, str], headers: dict[str, str] | None = None
) -> JSONResponse:
    content = content | {"request_id": request.scope["request_id"]}
    return JSONResponse(content, status, headers)
