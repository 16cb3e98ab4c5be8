"""The service as an ASGI application, from the top."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any

from fastapi import FastAPI, HTTPException, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response

import topoloc
from topoloc import AtlasConfig, Localizer, MapCache, TrackerConfig
from topoloc.apps.service import geopose_routes, map_routes, page_routes, stream_routes
from topoloc.apps.service.access_middleware import AccessMiddleware, App, RequestLimits
from topoloc.apps.service.config import ServiceConfig
from topoloc.apps.service.logs import log
from topoloc.apps.service.maintenance import run_maintenance
from topoloc.apps.service.metrics import Metrics
from topoloc.apps.service.query_handler import QueryHandler
from topoloc.apps.service.request_errors import RequestError
from topoloc.apps.service.served_atlases import ServedAtlases
from topoloc.apps.service.state import Service
from topoloc.apps.service.streams import Streams
from topoloc.apps.service.workers import Workers

_DESCRIPTION = """Where was this picture taken? Pictures become 6-DoF poses in maps that `topoloc build` made.

A picture that cannot be localized is an answer (200, `"localized": false` and why); requests that make no sense are refused in one
sentence."""  # noqa: E501


@dataclass(frozen=True)
class Access:
    """Who may ask: with a token, or on this machine alone."""

    token: str | None = None
    loopback_only: bool = True


def create_application(
    maps: MapCache[Localizer],
    config: ServiceConfig,
    access: Access,
    tracking: TrackerConfig | None = None,
    atlas_config: AtlasConfig | None = None,
) -> App:
    """The application; its maps are closed when it ends. `atlas_config` says how the tiles of its
    atlases are asked."""
    metrics = Metrics()
    atlases = ServedAtlases(maps, atlas_config or AtlasConfig())
    query_handler = QueryHandler(maps, config.max_pixels, 1e3 * config.answer_s, atlases)
    streams = Streams(
        maps, query_handler, tracking or TrackerConfig(), config.max_sessions, config.session_idle_s
    )
    service = Service(
        maps, query_handler, Workers(config.num_workers, config.max_queue), config, metrics, streams
    )
    _start_watching(service)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        log("ready", maps=maps.names(), workers=config.num_workers)
        atlases.watch()
        house = asyncio.create_task(run_maintenance(streams))
        yield
        house.cancel()
        await service.close()
        log("ended")

    app = FastAPI(
        title="topoloc",
        version=topoloc.__version__,
        description=_DESCRIPTION,
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
    )
    app.state.service = service
    for routes in (map_routes, geopose_routes, stream_routes, page_routes):
        app.include_router(routes.router)
    for kind in (RequestError, HTTPException, RequestValidationError):
        app.add_exception_handler(kind, _error_response)
    app.add_exception_handler(404, _error_response)
    app.add_exception_handler(405, _error_response)
    return AccessMiddleware(
        app,
        RequestLimits(access.token, access.loopback_only, config.max_upload_bytes, config.upload_s),
        metrics,
    )


def _start_watching(service: Service) -> None:
    gauge = service.metrics.gauge
    gauge(
        "topoloc_jobs",
        "Requests that are being answered or wait.",
        lambda: service.workers.num_jobs,
    )
    gauge("topoloc_streams", "Streams that are followed.", lambda: len(service.streams))
    gauge("topoloc_open_maps", "Maps that are open.", lambda: service.maps.num_open)
    gauge(
        "topoloc_open_map_bytes",
        "Bytes of the files of the maps that are open.",
        lambda: service.maps.num_bytes,
    )


async def _error_response(request: Request, error: Exception) -> Response:
    """The one form of every refusal."""
    status, text, headers = 500, str(error), dict[str, str]()
    if isinstance(error, RequestError):
        status, text, headers = error.status, error.text, error.headers
    elif isinstance(error, RequestValidationError):
        first: dict[str, Any] = dict(error.errors()[0])
        status, text = 422, f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    elif isinstance(error, HTTPException) or hasattr(error, "status_code"):
        failed: Any = error
        status, text, headers = failed.status_code, str(failed.detail), dict(failed.headers or {})
        text = f"nothing is at {request.url.path[:200]}" if status == 404 else text
    return JSONResponse(
        {"error": " ".join(text.split()), "request_id": request.scope["request_id"]},
        status,
        headers,
    )
