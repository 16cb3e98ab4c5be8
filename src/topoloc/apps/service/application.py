"""The service as an ASGI application."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass

from fastapi import FastAPI, HTTPException, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response

import topoloc
from topoloc import AtlasConfig, Localizer, MapCache, TrackerConfig
from topoloc.apps.service import geopose_routes, map_routes, stream_routes
from topoloc.apps.service.access_middleware import AccessMiddleware, App, RequestLimits
from topoloc.apps.service.config import ServiceConfig
from topoloc.apps.service.logs import Metrics, log
from topoloc.apps.service.query_handler import QueryHandler
from topoloc.apps.service.request_errors import RequestError
from topoloc.apps.service.served_atlases import ServedAtlases
from topoloc.apps.service.state import Service, Workers
from topoloc.apps.service.streams import Streams

_DESCRIPTION = """6-DoF poses of images in maps that `topoloc build` made.

The response for an image without a pose is 200 with `"localized": false` and the reason. Invalid
requests are refused with one sentence."""


@dataclass(frozen=True)
class Access:
    """The clients that may connect: with a token, or from this machine only."""

    token: str | None = None
    loopback_only: bool = True


def create_application(
    maps: MapCache[Localizer],
    config: ServiceConfig,
    access: Access,
    tracking: TrackerConfig | None = None,
    atlas_config: AtlasConfig | None = None,
) -> App:
    """Create the application. It closes the maps when it ends."""
    metrics = Metrics()
    atlases = ServedAtlases(maps, atlas_config or AtlasConfig())
    query_handler = QueryHandler(maps, config.max_pixels, 1e3 * config.answer_s, atlases)
    streams = Streams(
        maps, query_handler, tracking or TrackerConfig(), config.max_sessions, config.session_idle_s
    )
    workers = Workers(config.num_workers, config.max_queue)
    service = Service(maps, query_handler, workers, config, metrics, streams)
    metrics.gauge(
        "topoloc_jobs", "Requests in progress or waiting.", lambda: service.workers.num_jobs
    )
    metrics.gauge("topoloc_streams", "Open streams.", lambda: len(streams))
    metrics.gauge("topoloc_open_maps", "Open maps.", lambda: maps.num_open)
    metrics.gauge("topoloc_open_map_bytes", "Bytes of open map files.", lambda: maps.num_bytes)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        log("ready", maps=maps.names(), workers=config.num_workers)
        atlases.watch()
        maintenance = asyncio.create_task(streams.run_maintenance())
        yield
        maintenance.cancel()
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
    for routes in (map_routes, geopose_routes, stream_routes):
        app.include_router(routes.router)
    for kind in (RequestError, HTTPException, RequestValidationError, 404, 405):
        app.add_exception_handler(kind, _error_response)
    limits = RequestLimits(
        access.token, access.loopback_only, config.max_upload_bytes, config.upload_s
    )
    return AccessMiddleware(app, limits, metrics)


async def _error_response(request: Request, error: Exception) -> Response:
    """Convert any refusal to the response of a RequestError."""
    headers: dict[str, str] = {}
    if isinstance(error, RequestError):
        refusal, headers = error, error.headers
    elif isinstance(error, RequestValidationError):
        first = dict(error.errors()[0])
        refusal = RequestError(422, f"{'.'.join(map(str, first['loc']))}: {first['msg']}")
    else:
        status = getattr(error, "status_code", 500)
        text = f"nothing is at {request.url.path[:200]}" if status == 404 else None
        refusal = RequestError(status, text or str(getattr(error, "detail", error)))
        headers = dict(getattr(error, "headers", None) or {})
    return JSONResponse(refusal.to_json(request.scope["request_id"]), refusal.status, headers)
