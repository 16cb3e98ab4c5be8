"""The native routes: maps, and pictures localized in them."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request
from fastapi.responses import HTMLResponse, JSONResponse, Response

import topoloc
from topoloc.apps.service.answers import line_of, of_all_maps
from topoloc.apps.service.asked import Said, read_asked
from topoloc.apps.service.documents import PICTURE_BODY, answers, errors, result_schema
from topoloc.apps.service.state import service_of
from topoloc.geometry.camera import MODELS
from topoloc.mapping.description import describe_map

router = APIRouter()
MapName = Annotated[
    str, Path(description="a map's name: its file's, without .topo", max_length=200)
]


SaidInAddress = Annotated[Said, Query()]
_ASKING = errors(400, 401, 403, 404, 408, 413, 415, 422, 429, 503)


@router.get("/healthz", responses=errors(503))
async def health(request: Request) -> dict[str, Any]:
    """Whether the service lives."""
    service = service_of(request)
    return {"status": "ok", "jobs": service.workers.num_jobs, "open_maps": service.maps.num_open}


@router.get(
    "/metrics",
    response_class=Response,
    responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}} | errors(401),
)
async def metrics(request: Request) -> Response:
    """Counters and times, as Prometheus reads them."""
    return Response(service_of(request).metrics.text(), media_type="text/plain; version=0.0.4")


@router.get("/capabilities", responses=errors(401, 503))
async def capabilities(request: Request) -> dict[str, Any]:
    """What the service can do, for programs that look for one."""
    service = service_of(request)
    config = service.config
    return {
        "name": "topoloc",
        "version": topoloc.__version__,
        "services": ["localization", "geopose", "streams"],
        "maps": service.maps.names(),
        "camera_models": list(MODELS),
        "geopose_protocol": ["1.0", "2.0"],
        "limits": {
            "megabytes": config.max_upload_mb,
            "megapixels": config.max_megapixels,
            "sessions": config.max_sessions,
        },
    }


@router.get("/v1/maps", responses=errors(401, 503))
async def maps(request: Request) -> dict[str, list[str]]:
    """The names of all maps."""
    return {"maps": service_of(request).maps.names()}


@router.get("/v1/maps/{map}", responses=errors(401, 404, 422, 429, 503))
async def one_map(request: Request, map: MapName) -> JSONResponse:
    """What a map holds: what `topoloc info --json` prints, and each node with its pose."""
    service = service_of(request)

    def described() -> dict[str, Any]:
        with service.maps.lent(map) as opened:
            topomap = opened.localizer.topomap
            facts = describe_map(topomap, opened.path) | {"path": opened.path.name, "name": map}
            return facts | {"nodes": [_node_facts(summary) for summary in topomap.summaries]}

    return JSONResponse(await service.work(request, described))


@router.post(
    "/v1/maps/{map}/localize",
    responses=answers(
        result_schema(), "a pose, or why there is none: the JSON line of `topoloc localize --json`"
    )
    | _ASKING,
    openapi_extra=PICTURE_BODY,
)
async def localize(request: Request, map: MapName, said: SaidInAddress) -> Response:
    """Where was this picture taken?"""
    service, asked = service_of(request), await read_asked(request, said)
    result = await service.work(request, partial(service.answerer.localize, map, asked))
    service.count(request, map, result)
    return Response(line_of(result, asked.picture.name), media_type="application/json")


@router.post("/v1/localize", responses=_ASKING, openapi_extra=PICTURE_BODY)
async def localize_everywhere(request: Request, said: SaidInAddress) -> JSONResponse:
    """Where, and in which of the maps? `map` is the only one that vouches for a pose; null where
    none does, or several."""
    service, asked = service_of(request), await read_asked(request, said)
    results = await service.work(request, partial(service.answerer.localize_everywhere, asked))
    for map_name, result in results.items():
        service.count(request, map_name, result)
    return JSONResponse(of_all_maps(results, asked.picture.name))


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
    | _ASKING,
    openapi_extra=PICTURE_BODY,
)
async def explain(request: Request, map: MapName, said: SaidInAddress) -> Response:
    """Why this answer, or none: JSON, or the page of `topoloc explain` for those who accept
    text/html."""
    service, asked = service_of(request), await read_asked(request, said)
    as_page = "text/html" in request.headers.get("accept", "")
    text = await service.work(request, partial(service.answerer.explain, map, asked, as_page))
    return HTMLResponse(text) if as_page else Response(text, media_type="application/json")


def _node_facts(summary: Any) -> dict[str, Any]:
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
