"""Protocols of connections for uvicorn, with limits in time and in number for each client."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Coroutine, MutableMapping, Sequence
from ipaddress import ip_network
from typing import Any, TypeVar

from h11 import DONE, Request as RequestHead
from starlette.requests import HTTPConnection, Request
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from topoloc.apps.service.config import ServiceConfig
from topoloc.apps.service.logs import log
from topoloc.apps.service.request_errors import RequestError

R = TypeVar("R")

KEEP_ALIVE_S = 75
"""Longer than clients and load balancers keep a connection (5 to 60 s). Otherwise a request may
meet a connection that is being closed."""


def client_address(peer: Sequence[Any] | None) -> str:
    """Return the address of a client, whose host comes first in `peer`. A client has a whole /64
    network of IPv6."""
    host = str(peer[0]) if peer else ""
    is_ipv6 = ":" in host and "." not in host
    return str(ip_network((host.partition("%")[0], 64), False)) if is_ipv6 else host


class Connections:
    """All open connections, by address.

    Beyond `max_number` connections, or `max_share` of one address, the connection that has waited
    longest for its client is ended. In all it is one of the address with the most connections.
    """

    def __init__(self, max_number: int, max_share: int) -> None:
        self._max_number, self._max_share, self._number = max_number, max_share, 0
        self._by_address: dict[str, dict[_TimedProtocol, None]] = {}

    def add(self, connection: _TimedProtocol) -> None:
        """Add a connection, or move a known one to the end of its address."""
        self.remove(connection)
        mine = self._by_address.setdefault(connection.address, {})
        mine[connection] = None
        self._number += 1
        if len(mine) > self._max_share:
            self._end_one(mine)
        elif self._number > self._max_number:
            self._end_one(max(self._by_address.values(), key=len))

    def remove(self, connection: _TimedProtocol) -> None:
        """Forget a connection, which may be unknown."""
        mine = self._by_address.get(connection.address, {})
        if connection in mine:
            del mine[connection]
            self._number -= 1
            if not mine:
                del self._by_address[connection.address]

    def _end_one(self, mine: MutableMapping[_TimedProtocol, None]) -> None:
        if waiting := next((one for one in mine if one.is_waiting), None):
            log("too many connections", address=waiting.address, number=len(mine))
            self.remove(waiting)
            waiting.transport.abort()


class _TimedProtocol(asyncio.Protocol):
    """Aborts its connection if the client does not take an answer within `upload_s`.

    Mixed in before a protocol of uvicorn. The attributes of the class are set by `protocols`.
    """

    transport: asyncio.Transport
    connections_open: Connections
    upload_s = 20.0
    address = ""
    _write_timer: asyncio.TimerHandle | None = None

    @property
    def is_waiting(self) -> bool:
        """Whether the client has to act: to send a request, or to take an answer."""
        return self._write_timer is not None

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self.address = client_address(transport.get_extra_info("peername"))
        transport.set_write_buffer_limits(high=1, low=0)  # paused until all is taken
        if (opened := transport.get_extra_info("socket")) is not None:
            # asyncio does so only for listeners that name their protocol. Without it the body waits
            # 40 ms for the acknowledgement of the head.
            opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.connections_open.add(self)

    def connection_lost(self, exc: Exception | None) -> None:
        self.connections_open.remove(self)
        self._cancel_write_timer()
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        super().pause_writing()
        loop = asyncio.get_running_loop()
        self._write_timer = loop.call_later(self.upload_s, self.transport.abort)

    def resume_writing(self) -> None:
        self._cancel_write_timer()
        super().resume_writing()

    def _cancel_write_timer(self) -> None:
        if self._write_timer is not None:
            self._write_timer.cancel()
            self._write_timer = None


class _HttpProtocol(_TimedProtocol, H11Protocol):
    """HTTP/1.1 that closes a connection if no request head arrives in time."""

    _head_timer: asyncio.TimerHandle | None = None

    @property
    def is_waiting(self) -> bool:
        cycle = self.cycle
        is_at_work = cycle is not None and not cycle.response_complete and not cycle.more_body
        return super().is_waiting or not is_at_work

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._wait_for_head(self.upload_s)

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        if self._head_timer is not None:
            self._head_timer.cancel()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        # of requests that a client sends ahead, the first is answered
        is_complete = self.conn.their_state is DONE
        if is_complete and self.cycle is not None and self.conn.trailing_data[0]:
            self.cycle.keep_alive = False

    def on_response_complete(self) -> None:
        if self._head_timer is not None:
            self._head_timer.cancel()
        self._wait_for_head(KEEP_ALIVE_S + self.upload_s)
        if not self.transport.is_closing():
            self.connections_open.add(self)
        super().on_response_complete()

    def handle_websocket_upgrade(self, event: RequestHead) -> None:
        self.connections_open.remove(self)
        self._cancel_write_timer()
        if self._head_timer is not None:
            self._head_timer.cancel()
        super().handle_websocket_upgrade(event)

    def _wait_for_head(self, seconds: float) -> None:
        self._head_timer = self.loop.call_later(seconds, self._close_if_idle, self.cycle)

    def _close_if_idle(self, before: Any) -> None:
        is_ours = self.transport.get_protocol() is self and not self.transport.is_closing()
        if self.cycle is before and is_ours:
            self.transport.close()


class _WebSocketProtocol(_TimedProtocol, WebSocketsSansIOProtocol):
    """WebSockets that tell the client why a message is refused before the connection ends."""

    def handle_parser_exception(self) -> None:
        """Send the close frame, and read and drop the rest of the message for a moment.

        A connection that is closed while the client sends is reset, and the client never reads the
        frame.
        """
        closed = self.conn.close_sent
        if self.close_sent or closed is None:
            return
        end: Any = {"type": "websocket.disconnect", "code": closed.code, "reason": closed.reason}
        self.queue.put_nowait(end)
        self.transport.write(b"".join(self.conn.data_to_send()))
        self.close_sent = True
        self.close_timer = self.loop.call_later(2.0, self.transport.close)


def protocols(config: ServiceConfig, max_connections: int, behind_proxy: bool) -> dict[str, Any]:
    """Return the protocols as options of uvicorn. One address has a quarter of the connections;
    a proxy has all."""
    share = max_connections if behind_proxy else max_connections // 4
    shared = {"connections_open": Connections(max_connections, share), "upload_s": config.upload_s}
    return {
        "http": type("HttpProtocol", (_HttpProtocol,), shared),
        "ws": type("WebSocketProtocol", (_WebSocketProtocol,), shared),
    }


async def while_connected(request: HTTPConnection, running: Coroutine[Any, Any, R]) -> R:
    """Return the result, and cancel it if the client of an HTTP request goes away. Raises
    RequestError then."""
    if not isinstance(request, Request):
        return await running
    job = asyncio.create_task(running)
    gone = asyncio.create_task(_wait_for_disconnect(request))
    try:
        await asyncio.wait((job, gone), return_when=asyncio.FIRST_COMPLETED)
        if job.done():
            return job.result()
        gone.result()  # its error, if the rest of the request is too large or slow
        raise RequestError(499, "the client has gone")
    finally:
        job.cancel()
        gone.cancel()
        await asyncio.gather(job, gone, return_exceptions=True)


async def _wait_for_disconnect(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
