"""Streams over plain HTTP, a request a picture, and over a WebSocket."""

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

from topoloc.apps.service.map_routes import MapName, UrlParameters
from topoloc.apps.service.openapi_schemas import (
    IMAGE_BODY,
    error_responses,
    result_schema,
    success_response,
)
from topoloc.apps.service.query_request import QueryRequest, read_query_request
from topoloc.apps.service.request_errors import RequestError
from topoloc.apps.service.state import Service, get_service
from topoloc.apps.service.streams import Stream
from topoloc.plugin import EncodedImage, decode_json

router = APIRouter()
PROTOCOL = "topoloc"
"""The subprotocol that a browser asks for beside the one with its token."""
TimeNs = Annotated[
    int | None,
    Query(description="when it was taken, nanoseconds; now where nothing is said", ge=0, lt=2**63),
]
StreamCamera = Annotated[
    str | None,
    Query(description="of all its pictures, as the form's field `camera`", max_length=20_000),
]


class StreamFacts(BaseModel):
    """A stream by its id; it is forgotten where no picture comes for `idle_s` seconds."""

    session: str
    map: str
    idle_s: float


@router.post(
    "/v1/maps/{map}/sessions",
    status_code=201,
    responses=error_responses(401, 403, 404, 422, 429, 503),
)
async def begin(request: Request, map: MapName, camera: StreamCamera = None) -> StreamFacts:
    """Begin a stream: pictures that follow each other, so that each helps with the next."""
    service = get_service(request)
    stream = await service.run_job(request, lambda: service.streams.begin(map, camera))
    return StreamFacts(session=stream.id, map=map, idle_s=service.config.session_idle_s)


@router.post(
    "/v1/maps/{map}/sessions/{session}/pictures",
    responses=success_response(
        result_schema(), "as of a single picture, with `state` and the smoothed pose"
    )
    | error_responses(400, 401, 403, 404, 408, 409, 413, 415, 422, 429, 503),
    openapi_extra=IMAGE_BODY,
)
async def next_picture(
    request: Request, map: MapName, session: str, parameters: UrlParameters, t_ns: TimeNs = None
) -> Response:
    """The next picture of a stream."""
    service = get_service(request)
    stream, query_request = (
        service.streams.find(map, session),
        await read_query_request(request, parameters),
    )
    answer = await service.run_job(
        request,
        lambda: service.streams.next(
            stream, query_request, time.time_ns() if t_ns is None else t_ns
        ),
    )
    request.scope["facts"].update({"map": map, "outcome": answer["state"]})
    return Response(json.dumps(answer), media_type="application/json")


@router.delete(
    "/v1/maps/{map}/sessions/{session}",
    status_code=204,
    responses=error_responses(401, 403, 404, 422, 503),
)
async def end(request: Request, map: MapName, session: str) -> Response:
    """End a stream."""
    service = get_service(request)
    stream = service.streams.find(map, session)
    await asyncio.to_thread(service.streams.end, stream)
    return Response(status_code=204)


@router.websocket("/v1/maps/{map}/sessions")
async def stream_over_websocket(socket: WebSocket, map: str) -> None:
    """A stream as long as the connection: a binary message is a picture, its answer a text. A text
    message says what holds for the pictures after it: `{"camera": ..., "t_ns": ...}` (the time for
    the next one alone)."""
    service = get_service(socket)
    try:
        stream = await service.run_job(
            socket, lambda: service.streams.begin(map, socket.query_params.get("camera"))
        )
    except RequestError as refusal:
        await socket.send_denial_response(_reject_connection(socket, refusal))
        return
    try:
        await socket.accept(PROTOCOL if PROTOCOL in socket.scope.get("subprotocols", ()) else None)
        await _serve_websocket(socket, service, stream)
    except RequestError as refusal:
        await _close_socket(socket, refusal)
    except WebSocketDisconnect:
        pass
    finally:
        socket.scope["facts"].update({"map": map, "session": stream.id})
        await asyncio.to_thread(service.streams.end, stream)


async def _serve_websocket(socket: WebSocket, service: Service, stream: Stream) -> None:
    """Until the client goes away. Raises RequestError where it does not listen, or says nothing."""
    parameters: dict[str, Any] = {}
    number = 0
    while True:
        try:
            message = await asyncio.wait_for(socket.receive(), service.config.session_idle_s)
        except TimeoutError:
            raise RequestError(408, f"no picture for {service.config.session_idle_s:g} s") from None
        if message["type"] == "websocket.disconnect":
            return
        if message.get("text") is not None:
            parameters |= _parse_message(message["text"])
            continue
        t_ns = parameters.pop("t_ns", None) or time.time_ns()
        query_request = QueryRequest(
            EncodedImage(str(number), message["bytes"]), parameters.get("camera")
        )
        number += 1
        await _send_text(
            socket,
            await _localize_image(socket, service, stream, query_request, t_ns),
            service.config.upload_s,
        )


async def _localize_image(
    socket: WebSocket, service: Service, stream: Stream, query_request: QueryRequest, t_ns: int
) -> str:
    """The answer, or why this picture has none; the stream goes on."""
    try:
        return json.dumps(
            await service.run_job(socket, lambda: service.streams.next(stream, query_request, t_ns))
        )
    except RequestError as refusal:
        return json.dumps({"query": query_request.picture.name, "error": refusal.text})


async def _send_text(socket: WebSocket, text: str, timeout_s: float) -> None:
    try:
        await asyncio.wait_for(socket.send_text(text), timeout_s)
    except TimeoutError:
        raise RequestError(408, "the answers are not read") from None


class _Message(Struct, frozen=True, forbid_unknown_fields=True):
    camera: str | dict[str, Any] | UnsetType | None = UNSET
    t_ns: Annotated[int, Meta(ge=0, le=2**63 - 1)] | UnsetType | None = UNSET


def _parse_message(text: str) -> dict[str, Any]:
    """Return the keys of a text message. Raises RequestError."""
    message = decode_json(text, _Message, partial(RequestError, 422), "a text message")
    data = to_builtins(message)
    camera = data.get("camera")
    return data | {"camera": json.dumps(camera)} if isinstance(camera, dict) else data


async def _close_socket(socket: WebSocket, refusal: RequestError) -> None:
    with contextlib.suppress(TimeoutError, RuntimeError):  # it does not listen, or is gone
        await asyncio.wait_for(socket.close(1008, refusal.text[:120]), 1.0)


def _reject_connection(socket: WebSocket, refusal: RequestError) -> JSONResponse:
    body = {"error": refusal.text, "request_id": socket.scope["request_id"]}
    return JSONResponse(body, refusal.status, refusal.headers)
