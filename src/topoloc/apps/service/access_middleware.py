"""What every request passes before the service sees it: who may ask, how much, how slowly; its id,
its line in the log, its metrics."""

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
from urllib.parse import urlsplit

from topoloc.apps.service.logs import log
from topoloc.apps.service.metrics import Metrics
from topoloc.apps.service.request_errors import RequestError

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

LOOPBACK = ("127.0.0.1", "localhost", "[::1]", "::1")
BEARER_PROTOCOL = "bearer."
"""A browser's WebSocket cannot send headers; it names the subprotocols `topoloc` and this with the
token behind it."""
_PUBLIC_PATHS = ("/healthz", "/")
_PUBLIC_FOLDERS = ("/static/",)
_REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")
_DISCARD_S, _MAX_DISCARDED_BYTES = (
    1.0,
    64_000_000,
)  # of what a refused request still sends, thrown away unread


@dataclass(frozen=True)
class RequestLimits:
    """Who may come in, and how.

    `token` is asked of every request but those for the page itself and for /healthz; None asks
    nobody. With `loopback_only` a request must also call us by a name of this machine, so that no
    foreign page can reach us under a name of its own.
    """

    token: str | None
    loopback_only: bool
    max_bytes: int
    upload_s: float


class AccessMiddleware:
    """An ASGI application around another one."""

    def __init__(self, app: App, limits: RequestLimits, metrics: Metrics) -> None:
        self._app, self._limits, self._metrics = app, limits, metrics
        self._token_digest = (
            None if limits.token is None else sha256(limits.token.encode()).digest()
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        request = _Request(scope, receive, send, self._limits)
        try:
            self._check(request)
            await self._app(scope, request.receive, request.send)
        except RequestError as refusal:
            await request.reject(refusal)
        except asyncio.CancelledError:
            await request.reject(RequestError(503, "the service is ending"))
            raise
        except Exception as error:
            log("failure", logging.ERROR, error, request_id=request.id)
            await request.reject(
                RequestError(503, "the service failed at this request; its log says more")
            )
        finally:
            self._log_request(request)

    def _check(self, request: _Request) -> None:
        """Raises RequestError."""
        host, origin = request.header("host"), request.header("origin")
        if self._limits.loopback_only and _host_name(host) not in LOOPBACK:
            raise RequestError(
                421,
                "this service answers on this machine alone, by the names 127.0.0.1 and localhost",
            )
        if origin and urlsplit(origin).netloc.lower() != host.lower():
            raise RequestError(403, "requests from other sites' pages are not answered")
        path = request.scope["path"]
        is_public = (
            self._token_digest is None or path in _PUBLIC_PATHS or path.startswith(_PUBLIC_FOLDERS)
        )
        if not is_public and not hmac.compare_digest(
            sha256(request.token().encode()).digest(), self._token_digest or b""
        ):
            raise RequestError(
                401,
                "a bearer token is needed (Authorization: Bearer ...), and this is none or"
                " another one",
            )
        length = request.header("content-length")
        if length.isdigit() and int(length[:20]) > self._limits.max_bytes:
            raise RequestError(413, f"a request has at most {self._limits.max_bytes / 1e6:g} MB")

    def _log_request(self, request: _Request) -> None:
        seconds, route = (
            time.perf_counter() - request.start,
            getattr(request.scope.get("route"), "path", "none"),
        )
        self._metrics.requests.labels(route, request.status).inc()
        if request.scope["type"] == "http":
            self._metrics.seconds.labels(route).observe(seconds)
        method = request.scope.get("method", "WEBSOCKET")
        facts = {
            "method": method,
            "path": request.scope["path"][:200],
            "status": request.status,
            "ms": round(1e3 * seconds, 1),
        }
        client = (request.scope.get("client") or ("",))[0]
        log(
            "request",
            request_id=request.id,
            client=client,
            bytes=request.num_bytes,
            **facts,
            **request.facts,
        )


class _Request:
    """One request on its way in and out."""

    def __init__(self, scope: Scope, receive: Receive, send: Send, limits: RequestLimits) -> None:
        self.scope, self._receive, self._send, self._limits = scope, receive, send, limits
        self.start, self.num_bytes, self.status = time.perf_counter(), 0, 0
        self._headers = {
            name.decode("latin-1").lower(): value.decode("latin-1")
            for name, value in scope["headers"]
        }
        given = self.header("x-request-id")
        self.id = given if _REQUEST_ID.fullmatch(given) else uuid.uuid4().hex
        self.facts: dict[str, Any] = {}
        scope["request_id"], scope["facts"] = self.id, self.facts
        self._is_complete = scope["type"] == "websocket"

    def header(self, name: str) -> str:
        return self._headers.get(name, "")

    def token(self) -> str:
        """What the client shows; empty where it shows nothing."""
        kind, _, token = self.header("authorization").partition(" ")
        if kind.lower() == "bearer":
            return token.strip()
        offered = [one.strip() for one in self.header("sec-websocket-protocol").split(",")]
        return next(
            (
                one.removeprefix(BEARER_PROTOCOL)
                for one in offered
                if one.startswith(BEARER_PROTOCOL)
            ),
            "",
        )

    async def receive(self) -> Message:
        """The next part of the request; all of it must be there in time, and be no larger than may
        be."""
        if self._is_complete:
            return await self._receive()
        left_s = self.start + self._limits.upload_s - time.perf_counter()
        try:
            message = await asyncio.wait_for(self._receive(), max(left_s, 0.001))
        except TimeoutError:
            raise RequestError(
                408, f"the request was not there within {self._limits.upload_s:g} s"
            ) from None
        self.num_bytes += len(message.get("body", b""))
        self._is_complete = not message.get("more_body", False)
        if self.num_bytes > self._limits.max_bytes:
            raise RequestError(413, f"a request has at most {self._limits.max_bytes / 1e6:g} MB")
        return message

    async def send(self, message: Message) -> None:
        if message["type"] in ("http.response.start", "websocket.http.response.start"):
            self.status = message["status"]
            message["headers"] = [*message.get("headers", ()), (b"x-request-id", self.id.encode())]
        elif message["type"] == "websocket.accept":
            self.status = 101
        await self._send(message)

    async def reject(self, refusal: RequestError) -> None:
        """The answer, where none has begun; the connection is not used again, for the rest of the
        request may be on its way."""
        if self.status:
            return
        if self.scope["type"] == "websocket":
            await self._send_error(refusal, "websocket.http.response")
            return
        if refusal.status < 500 and not self.header("expect"):
            await self._discard_rest()
        await self._send_error(refusal, "http.response")

    async def _discard_rest(self) -> None:
        """For a moment: a connection that is closed while its client still sends is reset, and the
        client never reads why."""
        end, left = time.perf_counter() + _DISCARD_S, _MAX_DISCARDED_BYTES
        while not self._is_complete and left > 0:
            try:
                message = await asyncio.wait_for(
                    self._receive(), max(end - time.perf_counter(), 0.001)
                )
            except TimeoutError:
                return
            left -= len(message.get("body", b""))
            self._is_complete = not message.get("more_body", False)

    async def _send_error(self, refusal: RequestError, kind: str) -> None:
        body = json.dumps({"error": refusal.text, "request_id": self.id}).encode()
        headers = [
            (b"content-type", b"application/json"),
            (b"content-length", b"%d" % len(body)),
            (b"connection", b"close"),
        ]
        headers += [
            (name.lower().encode(), value.encode()) for name, value in refusal.headers.items()
        ]
        headers += [(b"www-authenticate", b"Bearer")] if refusal.status == 401 else []
        await self.send({"type": f"{kind}.start", "status": refusal.status, "headers": headers})
        await self.send({"type": f"{kind}.body", "body": body})


def _host_name(host: str) -> str:
    """The name in a Host header, without its port."""
    name = (
        host[: host.index("]") + 1]
        if host.startswith("[") and "]" in host
        else host.partition(":")[0]
    )
    return name.lower()
