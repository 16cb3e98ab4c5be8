"""The service as an ASGI application, and its server by uvicorn."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import socket
import sys
from collections.abc import AsyncIterator, Callable, Collection, Iterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import uvicorn
from fastapi import FastAPI, HTTPException, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response

import topoloc
from topoloc import AtlasConfig, Localizer, MapCache, TopolocError, TrackerConfig
from topoloc.apps.service import map_routes, note_routes, stream_routes
from topoloc.apps.service.access_middleware import AccessMiddleware, App, RequestLimits
from topoloc.apps.service.config import ServiceConfig
from topoloc.apps.service.connections import KEEP_ALIVE_S, protocols
from topoloc.apps.service.cross_origin import CrossOrigin
from topoloc.apps.service.logs import Metrics, log, log_json
from topoloc.apps.service.notes import NoteFiles
from topoloc.apps.service.openapi_schemas import complete_document
from topoloc.apps.service.protocols import discovery_routes, geopose_routes
from topoloc.apps.service.query_handler import ImageDecoder, QueryHandler, ServedAtlases
from topoloc.apps.service.request_errors import RequestError
from topoloc.apps.service.state import Service, Streams, Workers

_DESCRIPTION = """6-DoF poses of images in maps that `topoloc build` made.

The response for an image without a pose is 200 with `"localized": false` and the reason. Invalid
requests are refused with one sentence."""


def create_application(
    maps: MapCache[Localizer],
    config: ServiceConfig,
    token: str | None = None,
    loopback_only: bool = True,
    tracking: TrackerConfig | None = None,
    atlas_config: AtlasConfig | None = None,
    origins: Collection[str] = (),
) -> App:
    """Create the application. It closes the maps when it ends. See `RequestLimits` for `token` and
    `loopback_only`; pages of `origins` may ask."""
    metrics = Metrics()
    atlases = ServedAtlases(maps, atlas_config or AtlasConfig())
    query_handler = QueryHandler(
        maps, ImageDecoder(config.max_pixels), 1e3 * config.answer_s, atlases
    )
    streams = Streams(maps, query_handler, tracking or TrackerConfig(), config)
    workers = Workers(config.num_workers, config.max_queue)
    notes = NoteFiles(config.max_notes)
    service = Service(maps, query_handler, workers, config, metrics, streams, notes)
    metrics.gauge("topoloc_jobs", "Requests in progress or waiting.", lambda: workers.num_jobs)
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

    app = _Application(
        title="topoloc",
        version=topoloc.__version__,
        description=_DESCRIPTION,
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
        license_info={"name": "Apache-2.0", "identifier": "Apache-2.0"},
        generate_unique_id_function=lambda route: route.name,
    )
    app.state.service = service
    for routes in (map_routes, geopose_routes, note_routes, stream_routes, discovery_routes):
        app.include_router(routes.router)
    for kind in (RequestError, HTTPException, RequestValidationError, 404, 405):
        app.add_exception_handler(kind, _error_response)
    bounds = config.max_upload_bytes, config.upload_s
    limits = RequestLimits(token, loopback_only, *bounds, CrossOrigin(origins))
    return AccessMiddleware(app, limits, metrics)


class _Application(FastAPI):
    """The routes, and their document for generators of clients."""

    def openapi(self) -> dict[str, Any]:
        if self.openapi_schema is None:
            self.openapi_schema = complete_document(super().openapi())
        return self.openapi_schema


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


@dataclass(frozen=True)
class Address:
    """Address of the service. It uses TLS if the files are given. `on_ready` gets the port."""

    host: str
    port: int
    tls_cert: Path | None = None
    tls_key: Path | None = None
    behind_proxy: bool = False
    on_ready: Callable[[int], None] = lambda _: None


def serve(app: App, address: Address, limits: ServiceConfig) -> None:
    """Listen until SIGTERM or SIGINT. Requests in progress then have `limits.drain_s` seconds.
    Raises TopolocError: the address cannot be used."""
    config = uvicorn.Config(
        app,
        **protocols(limits, 1000, address.behind_proxy),
        ws_max_size=limits.max_upload_bytes,
        ws_per_message_deflate=False,
        access_log=False,
        log_config=None,
        server_header=False,
        proxy_headers=address.behind_proxy,
        timeout_keep_alive=KEEP_ALIVE_S,
        timeout_graceful_shutdown=round(limits.drain_s),
        ssl_certfile=address.tls_cert,
        ssl_keyfile=address.tls_key,
        lifespan="on",
    )
    listener = _create_socket(address)
    log_json()
    scheme = "https" if address.tls_cert else "http"
    host, port = listener.getsockname()[:2]
    shown = f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}"
    print(f"topoloc serves on {shown}", file=sys.stderr, flush=True)
    address.on_ready(port)
    asyncio.run(_Server(config).serve([listener]))


def _create_socket(address: Address) -> socket.socket:
    try:
        family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
        return socket.create_server((address.host, address.port), family=family, backlog=256)
    except OSError as error:
        where = f"{address.host}, port {address.port}"
        raise TopolocError(f"cannot listen on {where}: {error.strerror or error}") from None


class _Server(uvicorn.Server):
    """A server that ends with status 0 at a signal. uvicorn's own re-raises the signal."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        # the loop's own handlers do not exist on Windows; uvicorn looks ten times a second
        signals = (signal.SIGTERM, signal.SIGINT)
        before = [signal.signal(number, self.handle_exit) for number in signals]
        try:
            yield
        finally:
            for number, handler in zip(signals, before, strict=True):
                signal.signal(number, handler)
