"""Routes of streams: one HTTP request for each image, or a WebSocket."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, WebSocket, WebSocketDisconnect
from fastapi.responses import JSONResponse, Response
from msgspec import UNSET, Meta, Struct, UnsetType, to_builtins
from pydantic import BaseModel
from starlette.types import Message

from topoloc.apps.service.connections import client_address
from topoloc.apps.service.map_routes import MapName, UrlParameters
from topoloc.apps.service.openapi_schemas import (
    IMAGE_BODY,
    QUERY_ERRORS,
    error_responses,
    result_response,
)
from topoloc.apps.service.query_request import QueryRequest, read_query_request
from topoloc.apps.service.request_errors import RequestError
from topoloc.apps.service.state import Service, Stream, get_service
from topoloc.plugin import EncodedImage, decode_json

router = APIRouter(tags=["streams"])
PROTOCOL = "topoloc"
"""The subprotocol that a browser names beside the one with its token."""
TimeNs = Annotated[
    int | None, Query(description="time of the image, nanoseconds; default now", ge=0, lt=2**63)
]
StreamCamera = Annotated[
    str | None,
    Query(description="default of the parameter `camera` of its images", max_length=20_000),
]


class StreamFacts(BaseModel):
    """A stream and its id. It ends after `idle_s` seconds without an image."""

    session: str
    map: str
    idle_s: float


@router.post(
    "/v1/maps/{map}/sessions",
    status_code=201,
    responses=error_responses(401, 403, 404, 422, 429, 503),
)
async def begin_stream(request: Request, map: MapName, camera: StreamCamera = None) -> StreamFacts:
    """Begin a stream of successive images. Each result supports the next one."""
    service, address = get_service(request), client_address(request.client)
    stream = await service.run_job(request, lambda: service.streams.begin(map, camera, address))
    return StreamFacts(session=stream.id, map=map, idle_s=service.config.session_idle_s)


@router.post(
    "/v1/maps/{map}/sessions/{session}/pictures",
    responses=result_response("result of a single image, with `state` and the smoothed pose")
    | QUERY_ERRORS
    | error_responses(409),
    openapi_extra=IMAGE_BODY,
)
async def localize_next(
    request: Request, map: MapName, session: str, parameters: UrlParameters, t_ns: TimeNs = None
) -> Response:
    """Localize the next image of a stream."""
    service = get_service(request)
    stream = service.streams.find(map, session)
    query = await read_query_request(request, parameters)
    t_ns = time.time_ns() if t_ns is None else t_ns
    answer = await service.run_job(
        request, lambda: service.streams.next(stream, query, t_ns), query.stop
    )
    request.scope["facts"].update({"map": map, "outcome": answer["state"]})
    return Response(json.dumps(answer), media_type="application/json")


@router.delete(
    "/v1/maps/{map}/sessions/{session}",
    status_code=204,
    responses=error_responses(401, 403, 404, 422, 503),
)
async def end_stream(request: Request, map: MapName, session: str) -> Response:
    """End a stream."""
    service = get_service(request)
    stream = service.streams.find(map, session)
    await asyncio.to_thread(service.streams.end, stream)
    return Response(status_code=204)


@router.websocket("/v1/maps/{map}/sessions")
async def stream_over_websocket(socket: WebSocket, map: str) -> None:
    """Run a stream that ends with the connection.

    A binary message is an image, and its result is a text. A text message sets parameters of the
    next images: `{"camera": ..., "t_ns": ...}`. The time is that of the next image only.
    """
    service, camera = get_service(socket), socket.query_params.get("camera")
    address = client_address(socket.client)
    try:
        stream = await service.run_job(socket, lambda: service.streams.begin(map, camera, address))
    except RequestError as refusal:
        body = refusal.to_json(socket.scope["request_id"])
        await socket.send_denial_response(JSONResponse(body, refusal.status, refusal.headers))
        return
    try:
        await socket.accept(PROTOCOL if PROTOCOL in socket.scope.get("subprotocols", ()) else None)
        await _serve_websocket(socket, service, stream)
    except RequestError as refusal:
        with contextlib.suppress(TimeoutError, RuntimeError):  # the client is slow or gone
            await asyncio.wait_for(socket.close(1008, refusal.text[:120]), 1.0)
    except WebSocketDisconnect:
        pass
    finally:
        socket.scope["facts"].update({"map": map, "session": stream.id})
        await asyncio.to_thread(service.streams.end, stream)


async def _serve_websocket(socket: WebSocket, service: Service, stream: Stream) -> None:
    """Serve until the client disconnects. Raises RequestError if it does not read or send."""
    parameters: dict[str, Any] = {}
    number, ahead = 0, asyncio.ensure_future(socket.receive())
    while True:
        try:
            message = await asyncio.wait_for(ahead, service.config.session_idle_s)
        except TimeoutError:
            raise RequestError(408, f"no image for {service.config.session_idle_s:g} s") from None
        if message["type"] == "websocket.disconnect":
            return
        ahead = asyncio.ensure_future(socket.receive())
        if message.get("text") is not None:
            parameters |= _parse_message(message["text"])
            continue
        t_ns = parameters.pop("t_ns", None) or time.time_ns()
        query = QueryRequest(EncodedImage(str(number), message["bytes"]), parameters.get("camera"))
        number += 1
        ahead.add_done_callback(partial(_stop_if_closed, query))
        text = await _localize_image(socket, service, stream, query, t_ns)
        try:
            await asyncio.wait_for(socket.send_text(text), service.config.upload_s)
        except TimeoutError:
            raise RequestError(408, "the client does not read the results") from None


def _stop_if_closed(query: QueryRequest, ahead: asyncio.Future[Message]) -> None:
    """Stop a job if the next message is the end of the connection. A client that sends an image
    ahead is not watched: no further message is read, because it takes memory."""
    is_read = not ahead.cancelled() and ahead.exception() is None
    if is_read and ahead.result()["type"] == "websocket.disconnect":
        query.stop.set()


async def _localize_image(
    socket: WebSocket, service: Service, stream: Stream, query: QueryRequest, t_ns: int
) -> str:
    """Return the result, or the error of this image as JSON. The stream continues."""
    try:
        answer = await service.run_job(
            socket, lambda: service.streams.next(stream, query, t_ns), query.stop
        )
    except RequestError as refusal:
        answer = {"query": query.picture.name, "error": refusal.text}
    return json.dumps(answer)


class _Message(Struct, frozen=True, forbid_unknown_fields=True):
    camera: str | dict[str, Any] | UnsetType | None = UNSET
    t_ns: Annotated[int, Meta(ge=0, le=2**63 - 1)] | UnsetType | None = UNSET


def _parse_message(text: str) -> dict[str, Any]:
    """Return the keys of a text message. Raises RequestError."""
    message = decode_json(text, _Message, partial(RequestError, 422), "a text message")
    data = to_builtins(message)
    camera = data.get("camera")
    return data | {"camera": json.dumps(camera)} if isinstance(camera, dict) else data
