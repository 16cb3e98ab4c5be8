"""Routes of the page, the maps and single images."""

from __future__ import annotations

import base64
import json
import threading
from functools import cache, partial
from hashlib import sha256
from importlib import resources
from pathlib import PurePath
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request
from fastapi.responses import HTMLResponse, JSONResponse, Response
from pydantic import BaseModel

import topoloc
from topoloc import Camera
from topoloc.apps.service.openapi_schemas import (
    IMAGE_BODY,
    OBJECT_RESPONSE,
    PUBLIC,
    QUERY_ERRORS,
    QueryParameters,
    error_responses,
    named_response,
    result_response,
)
from topoloc.apps.service.protocols.discovery_messages import SPATIALDDS
from topoloc.apps.service.query_handler import combine_results, result_to_line
from topoloc.apps.service.query_request import read_query_request
from topoloc.apps.service.request_errors import RequestError
from topoloc.apps.service.state import Service, get_service
from topoloc.apps.viewer.document import SceneBudget, create_document
from topoloc.apps.viewer.page import MODULES, import_map, static_text

router = APIRouter()
MapName = Annotated[
    str, Path(description="name of a map: its file name without .topo", max_length=200)
]
UrlParameters = Annotated[QueryParameters, Query()]
_TYPES = {
    ".js": "text/javascript",
    ".css": "text/css",
    ".html": "text/html",
    ".LICENSE": "text/plain",
    ".md": "text/plain",
}
_NUM_CACHED_SCENES = 4


@router.get("/healthz", responses=error_responses(503), tags=["service"], openapi_extra=PUBLIC)
async def get_health(request: Request) -> dict[str, Any]:
    """Return the state of the service."""
    service = get_service(request)
    return {"status": "ok", "jobs": service.workers.num_jobs, "open_maps": service.maps.num_open}


@router.get(
    "/metrics",
    response_class=Response,
    responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}}
    | error_responses(401, 403),
    tags=["service"],
)
async def get_metrics(request: Request) -> Response:
    """Return counters and times for Prometheus."""
    return Response(get_service(request).metrics.text(), media_type="text/plain; version=0.0.4")


@router.get("/capabilities", responses=error_responses(401, 403, 503), tags=["service"])
async def get_capabilities(request: Request) -> dict[str, Any]:
    """Return the services, maps, camera models and limits."""
    service = get_service(request)
    config = service.config
    return {
        "name": "topoloc",
        "version": topoloc.__version__,
        "services": ["localization", "geopose", "streams"],
        "maps": service.maps.names(),
        "camera_models": Camera.model_names(),
        "geopose_protocol": ["1.0", "2.0"],
        "spatialdds": [SPATIALDDS],
        "limits": {
            "megabytes": config.max_upload_mb,
            "megapixels": config.max_megapixels,
            "sessions": config.max_sessions,
        },
    }


class MapNames(BaseModel):
    """The names of all maps of a service."""

    maps: list[str]


@router.get("/v1/maps", responses=error_responses(401, 403, 503), tags=["maps"])
async def list_maps(request: Request) -> MapNames:
    """Return the names of all maps."""
    return MapNames(maps=get_service(request).maps.names())


@router.get(
    "/v1/maps/{map}",
    responses=OBJECT_RESPONSE | error_responses(401, 403, 404, 422, 429, 503),
    tags=["maps"],
)
async def get_map(request: Request, map: MapName) -> JSONResponse:
    """Return the facts of a map, as `topoloc info --json`, and its nodes with their poses."""
    service = get_service(request)

    def describe() -> dict[str, Any]:
        with service.maps.use_map(map) as opened:
            topomap = opened.content.topomap
            nodes = [
                {
                    "node": summary.node_id,
                    "session": summary.session_id,
                    "world_from_cam": summary.world_from_cam.to_json(),
                    "num_points": summary.num_points,
                }
                for summary in topomap.summaries
            ]
            facts: dict[str, Any] = topomap.describe(opened.path)
            facts |= {"path": opened.path.name, "name": map}
            for session in facts["sessions"]:  # clients need no folders of the mapper's machine
                session["recording"] = PurePath(session["recording"]).name
            return facts | {"nodes": nodes}

    return JSONResponse(await service.run_job(request, describe))


@router.post(
    "/v1/maps/{map}/localize",
    responses=result_response("pose or refusal, as a line of `topoloc localize --json`")
    | QUERY_ERRORS,
    openapi_extra=IMAGE_BODY,
    tags=["localization"],
)
async def localize(request: Request, map: MapName, parameters: UrlParameters) -> Response:
    """Localize an image in one map."""
    service, query = get_service(request), await read_query_request(request, parameters)
    result = await service.run_job(
        request, partial(service.query_handler.localize, map, query), query.stop
    )
    service.count(request, map, result)
    return Response(result_to_line(result, query.picture.name), media_type="application/json")


@router.post(
    "/v1/localize",
    responses=named_response("ResultOfMaps", "results of all maps") | QUERY_ERRORS,
    openapi_extra=IMAGE_BODY,
    tags=["localization"],
)
async def localize_everywhere(request: Request, parameters: UrlParameters) -> JSONResponse:
    """Localize an image in all maps. `map` names the map of the only pose; it is null if there are
    no poses or several. `failed` names the maps that cannot be read."""
    service, query = get_service(request), await read_query_request(request, parameters)
    results, failures = await service.run_job(
        request, partial(service.query_handler.localize_everywhere, query), query.stop
    )
    for map_name, result in results.items():
        service.count(request, map_name, result)
    return JSONResponse(combine_results(results, failures, query.picture.name))


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
    | QUERY_ERRORS,
    openapi_extra=IMAGE_BODY,
    tags=["localization"],
)
async def explain(request: Request, map: MapName, parameters: UrlParameters) -> Response:
    """Localize an image and return all tried poses: JSON, or a page if text/html is accepted."""
    service, query = get_service(request), await read_query_request(request, parameters)
    as_page = "text/html" in request.headers.get("accept", "")
    text = await service.run_job(
        request, partial(service.query_handler.explain, map, query, as_page), query.stop
    )
    return HTMLResponse(text) if as_page else Response(text, media_type="application/json")


@router.get(
    "/v1/maps/{map}/scene",
    responses=OBJECT_RESPONSE | error_responses(401, 403, 404, 422, 429, 503),
    tags=["maps"],
)
async def get_scene(request: Request, map: MapName) -> Response:
    """Return a map for display: points, nodes with their images, and paths. See docs/viewer.md."""
    service, stop = get_service(request), threading.Event()
    body = await service.run_job(request, lambda: build_scene(service, map, stop), stop)
    return Response(body, media_type="application/json")


def build_scene(service: Service, name: str, stop: threading.Event) -> bytes:
    """Return the document of a map, cached while its file is unchanged. Raises RequestError when
    `stop` is set."""
    cached = service.scenes

    def check() -> None:
        if stop.is_set():
            raise RequestError(499, "the client has gone")

    with service.maps.use_map(name) as opened:
        if name in cached and cached[name][0] == opened.stamp:
            return cached[name][1]
        document = create_document(opened.content.topomap, name, (), SceneBudget(), check)
        body = json.dumps(document, separators=(",", ":")).encode()
        cached.pop(name, None)
        while len(cached) >= _NUM_CACHED_SCENES:
            cached.pop(next(iter(cached)), None)
        cached[name] = opened.stamp, body
        return body


@router.get("/", response_class=HTMLResponse, include_in_schema=False)
async def page() -> Response:
    """Return the page of the service."""
    text, policy = _render_page()
    return HTMLResponse(
        text, headers={"content-security-policy": policy, "referrer-policy": "no-referrer"}
    )


@router.get("/static/{name:path}", include_in_schema=False)
async def static(name: str) -> Response:
    """Return a file of the page."""
    if name not in _list_static_files():
        raise RequestError(404, f"nothing is at /static/{name[:80]}")
    return Response(
        static_text(name),
        media_type=_TYPES[name[name.rindex(".") :]],
        headers={"cache-control": "no-cache", "x-content-type-options": "nosniff"},
    )


@cache
def _render_page() -> tuple[str, str]:
    """Return the page and its content security policy, which allows this service only."""
    files = [file for file in sorted(_list_static_files()) if file.startswith("page/")]
    modules = {f"topoloc/{file[:-3]}": file for file in files if file.endswith(".js")}
    element = import_map(lambda file: f"/static/{file}", MODULES | modules)
    inside = element[element.index(">") + 1 : element.rindex("<")]
    digest = base64.b64encode(sha256(inside.encode()).digest()).decode("ascii")
    policy = (
        f"default-src 'none'; script-src 'self' 'sha256-{digest}'; style-src 'self'"
        " 'unsafe-inline'; img-src 'self' data: blob:; media-src 'self' blob:; connect-src 'self';"
        " base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return static_text("page/page.html").replace("<!--import map-->", element), policy


@cache
def _list_static_files() -> frozenset[str]:
    root = resources.files("topoloc.apps.viewer").joinpath("static")
    folders = (("", root), ("page/", root.joinpath("page")))
    return frozenset(
        prefix + file.name
        for prefix, folder in folders
        for file in folder.iterdir()
        if file.is_file()
    )
