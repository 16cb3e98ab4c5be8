"""Streams over plain HTTP, a request a picture, and over a WebSocket."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, WebSocket, WebSocketDisconnect
from fastapi.responses import JSONResponse, Response
from pydantic import BaseModel

from topoloc.apps.service.asked import Asked, json_of, read_asked
from topoloc.apps.service.documents import PICTURE_BODY, answers, errors, result_schema
from topoloc.apps.service.map_routes import MapName, SaidInAddress
from topoloc.apps.service.refusals import Refusal
from topoloc.apps.service.state import Service, service_of
from topoloc.apps.service.streams import Stream
from topoloc.recordings.pictures import PictureBytes

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
    "/v1/maps/{map}/sessions", status_code=201, responses=errors(401, 403, 404, 422, 429, 503)
)
async def begin(request: Request, map: MapName, camera: StreamCamera = None) -> StreamFacts:
    """Begin a stream: pictures that follow each other, so that each helps with the next."""
    service = service_of(request)
    stream = await service.work(request, lambda: service.streams.begin(map, camera))
    return StreamFacts(session=stream.id, map=map, idle_s=service.config.session_idle_s)


@router.post(
    "/v1/maps/{map}/sessions/{session}/pictures",
    responses=answers(result_schema(), "as of a single picture, with `state` and the smoothed pose")
    | errors(400, 401, 403, 404, 408, 409, 413, 415, 422, 429, 503),
    openapi_extra=PICTURE_BODY,
)
async def next_picture(
    request: Request, map: MapName, session: str, said: SaidInAddress, t_ns: TimeNs = None
) -> Response:
    """The next picture of a stream."""
    service = service_of(request)
    stream, asked = service.streams.find(map, session), await read_asked(request, said)
    answer = await service.work(
        request,
        lambda: service.streams.next(stream, asked, time.time_ns() if t_ns is None else t_ns),
    )
    request.scope["facts"].update({"map": map, "outcome": answer["state"]})
    return Response(json.dumps(answer), media_type="application/json")


@router.delete(
    "/v1/maps/{map}/sessions/{session}", status_code=204, responses=errors(401, 403, 404, 422, 503)
)
async def end(request: Request, map: MapName, session: str) -> Response:
    """End a stream."""
    service = service_of(request)
    stream = service.streams.find(map, session)
    await asyncio.to_thread(service.streams.end, stream)
    return Response(status_code=204)


@router.websocket("/v1/maps/{map}/sessions")
async def stream_over_websocket(socket: WebSocket, map: str) -> None:
    """A stream as long as the connection: a binary message is a picture, its answer a text. A text
    message says what holds for the pictures after it: `{"camera": ..., "t_ns": ...}` (the time for
    the next one alone)."""
    service = service_of(socket)
    try:
        stream = await service.work(
            socket, lambda: service.streams.begin(map, socket.query_params.get("camera"))
        )
    except Refusal as refusal:
        await socket.send_denial_response(_denied(socket, refusal))
        return
    try:
        await socket.accept(PROTOCOL if PROTOCOL in socket.scope.get("subprotocols", ()) else None)
        await _talk(socket, service, stream)
    except Refusal as refusal:
        await _close(socket, refusal)
    except WebSocketDisconnect:
        pass
    finally:
        socket.scope["facts"].update({"map": map, "session": stream.id})
        await asyncio.to_thread(service.streams.end, stream)


async def _talk(socket: WebSocket, service: Service, stream: Stream) -> None:
    """Until the client goes away. Raises Refusal where it does not listen, or says nothing."""
    said: dict[str, Any] = {}
    number = 0
    while True:
        try:
            message = await asyncio.wait_for(socket.receive(), service.config.session_idle_s)
        except TimeoutError:
            raise Refusal(408, f"no picture for {service.config.session_idle_s:g} s") from None
        if message["type"] == "websocket.disconnect":
            return
        if message.get("text") is not None:
            said |= _said(message["text"])
            continue
        t_ns = said.pop("t_ns", None) or time.time_ns()
        asked = Asked(PictureBytes(str(number), message["bytes"]), said.get("camera"))
        number += 1
        await _send(
            socket, await _answered(socket, service, stream, asked, t_ns), service.config.upload_s
        )


async def _answered(
    socket: WebSocket, service: Service, stream: Stream, asked: Asked, t_ns: int
) -> str:
    """The answer, or why this picture has none; the stream goes on."""
    try:
        return json.dumps(
            await service.work(socket, lambda: service.streams.next(stream, asked, t_ns))
        )
    except Refusal as refusal:
        return json.dumps({"query": asked.picture.name, "error": refusal.text})


async def _send(socket: WebSocket, text: str, timeout_s: float) -> None:
    try:
        await asyncio.wait_for(socket.send_text(text), timeout_s)
    except TimeoutError:
        raise Refusal(408, "the answers are not read") from None


def _said(text: str) -> dict[str, Any]:
    """What a text message says. Raises Refusal."""
    data = json_of(text, "the message")
    if not isinstance(data, dict) or not set(data) <= {"camera", "t_ns"}:
        raise Refusal(422, 'a text message is an object of "camera" and "t_ns"')
    t_ns, camera = data.get("t_ns"), data.get("camera")
    if t_ns is not None and (
        isinstance(t_ns, bool) or not isinstance(t_ns, int) or not 0 <= t_ns < 2**63
    ):
        raise Refusal(422, "t_ns is an integer of nanoseconds")
    return data if isinstance(camera, str | None) else data | {"camera": json.dumps(camera)}


async def _close(socket: WebSocket, refusal: Refusal) -> None:
    with contextlib.suppress(TimeoutError, RuntimeError):  # it does not listen, or is gone
        await asyncio.wait_for(socket.close(1008, refusal.text[:120]), 1.0)


def _denied(socket: WebSocket, refusal: Refusal) -> JSONResponse:
    body = {"error": refusal.text, "request_id": socket.scope["request_id"]}
    return JSONResponse(body, refusal.status, refusal.headers)
