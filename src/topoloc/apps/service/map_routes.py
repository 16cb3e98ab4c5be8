"""The native routes: maps, and pictures localized in them."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request
from fastapi.responses import HTMLResponse, JSONResponse, Response

import topoloc
from topoloc import Camera
from topoloc.apps.service.openapi_schemas import (
    IMAGE_BODY,
    error_responses,
    result_schema,
    success_response,
)
from topoloc.apps.service.query_handler import combine_results, result_to_line
from topoloc.apps.service.query_request import QueryParameters, read_query_request
from topoloc.apps.service.state import get_service

router = APIRouter()
MapName = Annotated[
    str, Path(description="a map's name: its file's, without .topo", max_length=200)
]


UrlParameters = Annotated[QueryParameters, Query()]
_QUERY_ERRORS = error_responses(400, 401, 403, 404, 408, 413, 415, 422, 429, 503)


@router.get("/healthz", responses=error_responses(503))
async def health(request: Request) -> dict[str, Any]:
    """Whether the service lives."""
    service = get_service(request)
    return {"status": "ok", "jobs": service.workers.num_jobs, "open_maps": service.maps.num_open}


@router.get(
    "/metrics",
    response_class=Response,
    responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}}
    | error_responses(401),
)
async def metrics(request: Request) -> Response:
    """Counters and times, as Prometheus reads them."""
    return Response(get_service(request).metrics.text(), media_type="text/plain; version=0.0.4")


@router.get("/capabilities", responses=error_responses(401, 503))
async def capabilities(request: Request) -> dict[str, Any]:
    """What the service can do, for programs that look for one."""
    service = get_service(request)
    config = service.config
    return {
        "name": "topoloc",
        "version": topoloc.__version__,
        "services": ["localization", "geopose", "streams"],
        "maps": service.maps.names(),
        "camera_models": Camera.model_names(),
        "geopose_protocol": ["1.0", "2.0"],
        "limits": {
            "megabytes": config.max_upload_mb,
            "megapixels": config.max_megapixels,
            "sessions": config.max_sessions,
        },
    }


@router.get("/v1/maps", responses=error_responses(401, 503))
async def maps(request: Request) -> dict[str, list[str]]:
    """The names of all maps."""
    return {"maps": get_service(request).maps.names()}


@router.get("/v1/maps/{map}", responses=error_responses(401, 404, 422, 429, 503))
async def one_map(request: Request, map: MapName) -> JSONResponse:
    """What a map holds: what `topoloc info --json` prints, and each node with its pose."""
    service = get_service(request)

    def describe() -> dict[str, Any]:
        with service.maps.use_map(map) as opened:
            topomap = opened.content.topomap
            facts = topomap.describe(opened.path) | {"path": opened.path.name, "name": map}
            return facts | {"nodes": [_node_to_json(summary) for summary in topomap.summaries]}

    return JSONResponse(await service.run_job(request, describe))


@router.post(
    "/v1/maps/{map}/localize",
    responses=success_response(
        result_schema(), "a pose, or why there is none: the JSON line of `topoloc localize --json`"
    )
    | _QUERY_ERRORS,
    openapi_extra=IMAGE_BODY,
)
async def localize(request: Request, map: MapName, parameters: UrlParameters) -> Response:
    """Where was this picture taken?"""
    service, asked = get_service(request), await read_query_request(request, parameters)
    result = await service.run_job(request, partial(service.query_handler.localize, map, asked))
    service.count(request, map, result)
    return Response(result_to_line(result, asked.picture.name), media_type="application/json")


@router.post("/v1/localize", responses=_QUERY_ERRORS, openapi_extra=IMAGE_BODY)
async def localize_everywhere(request: Request, parameters: UrlParameters) -> JSONResponse:
    """Where, and in which of the maps? `map` is the only one that vouches for a pose; null where
    none does, or several."""
    service, asked = get_service(request), await read_query_request(request, parameters)
    results = await service.run_job(
        request, partial(service.query_handler.localize_everywhere, asked)
    )
    for map_name, result in results.items():
        service.count(request, map_name, result)
    return JSONResponse(combine_results(results, asked.picture.name))


@router.post(
    "/v1/maps/{map}/explain",
    response_class=Response,
    responses={
        200: {
            "content": {
                "application/json": {"schema": {"type": "object"}},
                "text/html": {"schema": {"type": "string"}},
            }
        }
    }
    | _QUERY_ERRORS,
    openapi_extra=IMAGE_BODY,
)
async def explain(request: Request, map: MapName, parameters: UrlParameters) -> Response:
    """Why this answer, or none: JSON, or the page of `topoloc explain` for those who accept
    text/html."""
    service, asked = get_service(request), await read_query_request(request, parameters)
    as_page = "text/html" in request.headers.get("accept", "")
    text = await service.run_job(
        request, partial(service.query_handler.explain, map, asked, as_page)
    )
    return HTMLResponse(text) if as_page else Response(text, media_type="application/json")


def _node_to_json(summary: Any) -> dict[str, Any]:
    pose = summary.world_from_cam
    return {
        "node": summary.node_id,
        "session": summary.session_id,
        "world_from_cam": {
            "translation": pose.translation.tolist(),
            "quat_wxyz": pose.quat_wxyz().tolist(),
        },
        "num_points": summary.num_points,
    }
