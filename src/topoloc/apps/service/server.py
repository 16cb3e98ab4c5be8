"""Run the service with uvicorn."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import socket
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from topoloc import TopolocError
from topoloc.apps.service.access_middleware import App
from topoloc.apps.service.config import ServiceConfig
from topoloc.apps.service.logs import log_json

_MAX_CONNECTIONS = 1000
_KEEP_ALIVE_S = 75
"""Longer than clients and load balancers keep a connection (5 to 60 s). Otherwise a request may
meet a connection that is being closed."""


@dataclass(frozen=True)
class Address:
    """Address of the service. It uses TLS if the files are given."""

    host: str
    port: int
    tls_cert: Path | None = None
    tls_key: Path | None = None
    behind_proxy: bool = False


def serve(app: App, address: Address, limits: ServiceConfig) -> None:
    """Listen until SIGTERM or SIGINT. Requests in progress then have `limits.drain_s` seconds.

    Raises:
        TopolocError: the address cannot be used.
    """
    config = uvicorn.Config(
        app,
        http=type("_PatientHere", (_HeadTimeoutProtocol,), {"head_s": limits.upload_s}),
        ws_max_size=limits.max_upload_bytes,
        ws_per_message_deflate=False,
        access_log=False,
        log_config=None,
        server_header=False,
        proxy_headers=address.behind_proxy,
        limit_concurrency=_MAX_CONNECTIONS,
        timeout_keep_alive=_KEEP_ALIVE_S,
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
    asyncio.run(_Server(config).serve([listener]))


def _create_socket(address: Address) -> socket.socket:
    try:
        family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
        return socket.create_server((address.host, address.port), family=family, backlog=256)
    except OSError as error:
        raise TopolocError(
            f"cannot listen on {address.host}, port {address.port}: {error.strerror or error}"
        ) from None


class _Server(uvicorn.Server):
    """A server that ends with status 0 at a signal. uvicorn's own re-raises the signal."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        loop = asyncio.get_running_loop()
        signals = (signal.SIGTERM, signal.SIGINT)
        for number in signals:
            loop.add_signal_handler(number, self.handle_exit, number, None)
        try:
            yield
        finally:
            for number in signals:
                loop.remove_signal_handler(number)


class _HeadTimeoutProtocol(H11Protocol):
    """HTTP/1.1 that closes a connection if no request head arrives in time."""

    head_s = 10.0
    _timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._wait_for_head(self.head_s)

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        if self._timer is not None:
            self._timer.cancel()

    def on_response_complete(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._wait_for_head(_KEEP_ALIVE_S + self.head_s)
        super().on_response_complete()

    def _wait_for_head(self, seconds: float) -> None:
        self._timer = self.loop.call_later(seconds, self._close_if_idle, self.cycle)

    def _close_if_idle(self, before: Any) -> None:
        is_ours = self.transport.get_protocol() is self and not self.transport.is_closing()
        if self.cycle is before and is_ours:
            self.transport.close()
