"""Checks of every request before the routes: access, size and time. It also logs and counts."""

from __future__ import annotations

import asyncio
import hmac
import json
import logging
import re
import time
import uuid
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass
from hashlib import sha256
from typing import Any
from urllib.parse import unquote

from topoloc.apps.service.cross_origin import CrossOrigin
from topoloc.apps.service.logs import Metrics, log
from topoloc.apps.service.request_errors import RequestError

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

LOOPBACK = ("127.0.0.1", "localhost", "[::1]", "::1")
BEARER_PROTOCOL = "bearer."
"""WebSockets of browsers cannot send headers. They name the subprotocols `topoloc` and this prefix
with the token, percent-encoded where it has signs that no subprotocol may have."""
_PUBLIC_PATHS = ("/healthz", "/")
_PUBLIC_FOLDERS = ("/static/",)
_REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")
# Limits of the rest of a refused request, which is read and dropped.
_DISCARD_S, _MAX_DISCARDED_BYTES = 1.0, 64_000_000


@dataclass(frozen=True)
class RequestLimits:
    """Access and limits of requests.

    Attributes:
        token: required by every request but those for the page and /healthz; None for no token.
        loopback_only: the Host header must name this machine. This stops pages of other sites that
            reach the service under their own name.
        max_bytes: size of a request.
        upload_s: seconds until a request must be complete.
        cross_origin: the pages of other sites that may ask.
    """

    token: str | None
    loopback_only: bool
    max_bytes: int
    upload_s: float
    cross_origin: CrossOrigin


class AccessMiddleware:
    """An ASGI application that wraps another one."""

    def __init__(self, app: App, limits: RequestLimits, metrics: Metrics) -> None:
        self._app, self._limits, self._metrics = app, limits, metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        request = _Request(scope, receive, send, self._limits)
        try:
            self._check_sender(request)
            if request.is_preflight:
                await request.send_preflight()
                return
            self._check_request(request)
            await self._app(scope, request.receive, request.send)
        except RequestError as refusal:
            await request.reject(refusal)
        except asyncio.CancelledError:
            await request.reject(RequestError(503, "the service is ending"))
            raise
        except Exception as error:
            log("failure", logging.ERROR, error, request_id=request.id)
            await request.reject(
                RequestError(503, "the service failed at this request; see its log")
            )
        finally:
            self._log_request(request)

    def _check_sender(self, request: _Request) -> None:
        """Check host and origin. Raises RequestError."""
        host, origin = request.header("host"), request.header("origin")
        if self._limits.loopback_only and _host_name(host) not in LOOPBACK:
            raise RequestError(
                421, "this service answers on this machine only, as 127.0.0.1 and localhost"
            )
        if not self._limits.cross_origin.allows(origin, host):
            raise RequestError(
                403, f"pages of {origin[:80]} are not answered; allow them with --allow-origin"
            )

    def _check_request(self, request: _Request) -> None:
        """Check token and announced size. Raises RequestError."""
        path, token = request.scope["path"], self._limits.token
        is_public = path in _PUBLIC_PATHS or path.startswith(_PUBLIC_FOLDERS)
        if token is not None and not is_public:
            given, wanted = (sha256(text.encode()).digest() for text in (request.token(), token))
            if not hmac.compare_digest(given, wanted):
                raise RequestError(
                    401, "the bearer token (Authorization: Bearer ...) is missing or wrong"
                )
        length = request.header("content-length")
        if length.isdigit():
            request.check_size(int(length[:20]))

    def _log_request(self, request: _Request) -> None:
        seconds, scope = time.perf_counter() - request.start, request.scope
        route = getattr(scope.get("route"), "path", "none")
        self._metrics.requests.labels(route, request.status).inc()
        if scope["type"] == "http":
            self._metrics.seconds.labels(route).observe(seconds)
        facts = {
            "request_id": request.id,
            "client": (scope.get("client") or ("",))[0],
            "bytes": request.num_bytes,
            "method": scope.get("method", "WEBSOCKET"),
            "path": scope["path"][:200],
            "status": request.status,
            "ms": round(1e3 * seconds, 1),
        }
        log("request", **facts, **request.facts)


class _Request:
    """One request and its response."""

    def __init__(self, scope: Scope, receive: Receive, send: Send, limits: RequestLimits) -> None:
        self.scope, self._receive, self._send, self._limits = scope, receive, send, limits
        self.start, self.num_bytes, self.status = time.perf_counter(), 0, 0
        decoded = [
            (name.decode("latin-1"), value.decode("latin-1")) for name, value in scope["headers"]
        ]
        self._headers = {name.lower(): value for name, value in decoded}
        given = self.header("x-request-id")
        self.id = given if _REQUEST_ID.fullmatch(given) else uuid.uuid4().hex
        self.facts: dict[str, Any] = {}
        scope["request_id"], scope["facts"] = self.id, self.facts
        self._is_complete = scope["type"] == "websocket"

    def header(self, name: str) -> str:
        return self._headers.get(name, "")

    def token(self) -> str:
        """Return the token of the client, "" if there is none."""
        kind, _, token = self.header("authorization").partition(" ")
        if kind.lower() == "bearer":
            return token.strip()
        offered = (one.strip() for one in self.header("sec-websocket-protocol").split(","))
        tokens = [one for one in offered if one.startswith(BEARER_PROTOCOL)]
        return unquote(tokens[0].removeprefix(BEARER_PROTOCOL)) if tokens else ""

    @property
    def is_preflight(self) -> bool:
        """Whether a browser asks for the headers of a later request. It sends no token."""
        is_options = self.scope.get("method") == "OPTIONS" and bool(self.header("origin"))
        return is_options and bool(self.header("access-control-request-method"))

    async def send_preflight(self) -> None:
        """Tell a browser which requests the pages of an allowed origin may send."""
        is_private_network = bool(self.header("access-control-request-private-network"))
        headers = self._limits.cross_origin.preflight_headers(is_private_network)
        start = {"status": 204, "headers": _encode_headers(headers)}
        await self.send({"type": "http.response.start"} | start)
        await self.send({"type": "http.response.body"})

    def check_size(self, num_bytes: int) -> None:
        """Raise RequestError if a request of this size is too large."""
        if num_bytes > self._limits.max_bytes:
            raise RequestError(413, f"a request has at most {self._limits.max_bytes / 1e6:g} MB")

    async def receive(self) -> Message:
        """Return the next part. Raises RequestError if the request is too slow or too large."""
        if self._is_complete:
            return await self._receive()
        left_s = self.start + self._limits.upload_s - time.perf_counter()
        try:
            message = await asyncio.wait_for(self._receive(), max(left_s, 0.001))
        except TimeoutError:
            raise RequestError(
                408, f"the request was not complete within {self._limits.upload_s:g} s"
            ) from None
        self.num_bytes += len(message.get("body", b""))
        self._is_complete = not message.get("more_body", False)
        self.check_size(self.num_bytes)
        return message

    async def send(self, message: Message) -> None:
        if message["type"] in ("http.response.start", "websocket.http.response.start"):
            self.status = message["status"]
            more = self._limits.cross_origin.response_headers(self.header("origin"))
            added = _encode_headers({"x-request-id": self.id} | more)
            message["headers"] = [*message.get("headers", ()), *added]
        elif message["type"] == "websocket.accept":
            self.status = 101
        await self._send(message)

    async def reject(self, refusal: RequestError) -> None:
        """Send the refusal unless a response has begun, and close the connection."""
        if self.status:
            return
        is_websocket = self.scope["type"] == "websocket"
        if not is_websocket and refusal.status < 500 and not self.header("expect"):
            await self._discard_rest()
        kind = "websocket.http.response" if is_websocket else "http.response"
        body = json.dumps(refusal.to_json(self.id)).encode()
        headers = {"content-type": "application/json", "content-length": str(len(body))}
        headers |= {"connection": "close"} | refusal.headers
        headers |= {"www-authenticate": "Bearer"} if refusal.status == 401 else {}
        start = {"status": refusal.status, "headers": _encode_headers(headers)}
        await self.send({"type": f"{kind}.start"} | start)
        await self.send({"type": f"{kind}.body", "body": body})

    async def _discard_rest(self) -> None:
        """Read and drop the rest for a moment.

        A connection that is closed while the client sends is reset, and the client never reads the
        response.
        """
        end, left = time.perf_counter() + _DISCARD_S, _MAX_DISCARDED_BYTES
        while not self._is_complete and left > 0:
            left_s = max(end - time.perf_counter(), 0.001)
            try:
                message = await asyncio.wait_for(self._receive(), left_s)
            except TimeoutError:
                return
            left -= len(message.get("body", b""))
            self._is_complete = not message.get("more_body", False)


def _encode_headers(headers: dict[str, str]) -> list[tuple[bytes, bytes]]:
    return [(name.lower().encode(), value.encode("latin-1")) for name, value in headers.items()]


def _host_name(host: str) -> str:
    """Return the name in a Host header, without the port."""
    if host.startswith("[") and "]" in host:
        return host[: host.index("]") + 1].lower()
    return host.partition(":")[0].lower()
