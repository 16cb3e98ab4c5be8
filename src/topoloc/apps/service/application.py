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
from topoloc.apps.service import geopose_routes, map_routes, page_routes, stream_routes
from topoloc.apps.service.answers import Answerer
from topoloc.apps.service.config import ServiceConfig
from topoloc.apps.service.guard import App, Door, Guard
from topoloc.apps.service.housekeeping import keep_house
from topoloc.apps.service.logs import log
from topoloc.apps.service.metrics import Metrics
from topoloc.apps.service.refusals import Refusal
from topoloc.apps.service.served_atlases import ServedAtlases
from topoloc.apps.service.state import Service
from topoloc.apps.service.streams import Streams
from topoloc.apps.service.workers import Workers
from topoloc.atlas.config import AtlasConfig
from topoloc.atlas.open_maps import Maps
from topoloc.tracking.tracker import TrackerConfig

_ABOUT = """Where was this picture taken? Pictures become 6-DoF poses in maps that `topoloc build` made.

A picture that cannot be localized is an answer (200, `"localized": false` and why); requests that make no sense are refused in one
sentence."""  # noqa: E501


@dataclass(frozen=True)
class Access:
    """Who may ask: with a token, or on this machine alone."""

    token: str | None = None
    loopback_only: bool = True


def make_application(
    maps: Maps,
    config: ServiceConfig,
    access: Access,
    tracking: TrackerConfig | None = None,
    asked: AtlasConfig | None = None,
) -> App:
    """The application; its maps are closed when it ends. `asked` says how the tiles of its atlases
    are asked."""
    metrics = Metrics()
    atlases = ServedAtlases(maps, asked or AtlasConfig())
    answerer = Answerer(maps, config.max_pixels, 1e3 * config.answer_s, atlases)
    streams = Streams(
        maps, answerer, tracking or TrackerConfig(), config.max_sessions, config.session_idle_s
    )
    service = Service(
        maps, answerer, Workers(config.num_workers, config.max_queue), config, metrics, streams
    )
    _watch(service)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        log("ready", maps=maps.names(), workers=config.num_workers)
        atlases.watch()
        house = asyncio.create_task(keep_house(streams))
        yield
        house.cancel()
        await service.close()
        log("ended")

    app = FastAPI(
        title="topoloc",
        version=topoloc.__version__,
        description=_ABOUT,
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
    )
    app.state.service = service
    for routes in (map_routes, geopose_routes, stream_routes, page_routes):
        app.include_router(routes.router)
    for kind in (Refusal, HTTPException, RequestValidationError):
        app.add_exception_handler(kind, _refused)
    app.add_exception_handler(404, _refused)
    app.add_exception_handler(405, _refused)
    return Guard(
        app,
        Door(access.token, access.loopback_only, config.max_upload_bytes, config.upload_s),
        metrics,
    )


def _watch(service: Service) -> None:
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


async def _refused(request: Request, error: Exception) -> Response:
    """The one form of every refusal."""
    status, text, headers = 500, str(error), dict[str, str]()
    if isinstance(error, Refusal):
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
