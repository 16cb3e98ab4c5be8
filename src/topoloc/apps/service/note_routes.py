"""Routes of the notes of a map."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Request
from fastapi.responses import Response
from pydantic import BaseModel, Field, StringConstraints

from topoloc import TopoMetricMap
from topoloc.apps.service.map_routes import MapName
from topoloc.apps.service.notes import MAX_TEXT
from topoloc.apps.service.openapi_schemas import error_responses
from topoloc.apps.service.protocols.geopose_messages import GeoPoseOgc
from topoloc.apps.service.request_errors import RequestError
from topoloc.apps.service.state import Service, get_service

router = APIRouter(tags=["notes"])
R = TypeVar("R")
_Text = StringConstraints(strip_whitespace=True, min_length=1, max_length=MAX_TEXT)
_Number = Annotated[float, Field(ge=-1e9, le=1e9)]
_Position = Annotated[
    list[_Number], Field(min_length=3, max_length=3, description="metres, axes of the map's world")
]


class NewNote(BaseModel):
    """A note at a place of the map."""

    text: Annotated[str, _Text]
    position: _Position


class NoteId(BaseModel):
    """The id of a note that was added."""

    id: str


class NoteFacts(NoteId):
    """A note. `geopose` is its place on earth, if the map has one, upright towards the east."""

    text: str
    created: str
    position: _Position
    geopose: GeoPoseOgc | None = None


class NoteList(BaseModel):
    """All notes of a map, the oldest first. `revision` differs once the file of the map does."""

    map: str
    revision: str
    notes: list[NoteFacts]


@router.get(
    "/v1/maps/{map}/notes",
    responses=error_responses(401, 403, 404, 422, 429, 503),
    response_model_exclude_none=True,
)
async def list_notes(request: Request, map: MapName) -> NoteList:
    """Return the notes of a map."""
    service = get_service(request)

    def read(path: Path, topomap: TopoMetricMap) -> dict[str, Any]:
        status = path.stat()
        revision = f"{status.st_mtime_ns:x}-{status.st_size:x}"
        notes = service.notes.list_notes(path, topomap)
        return {"map": map, "revision": revision, "notes": notes}

    return NoteList.model_validate(await _with_map(request, map, read))


@router.post(
    "/v1/maps/{map}/notes",
    status_code=201,
    responses=error_responses(401, 403, 404, 409, 422, 429, 503),
)
async def add_note(request: Request, map: MapName, note: NewNote) -> NoteId:
    """Add a note, and return its id."""
    service = get_service(request)
    _check_is_file(service, map)
    add = partial(service.notes.add, text=note.text, position=note.position)
    return NoteId(id=await _with_map(request, map, add))


@router.delete(
    "/v1/maps/{map}/notes/{note}",
    status_code=204,
    responses=error_responses(401, 403, 404, 409, 422, 429, 503),
)
async def remove_note(request: Request, map: MapName, note: str) -> Response:
    """Delete a note."""
    service = get_service(request)
    _check_is_file(service, map)
    await _with_map(request, map, partial(service.notes.remove, note_id=note))
    return Response(status_code=204)


async def _with_map(request: Request, name: str, job: Callable[[Path, TopoMetricMap], R]) -> R:
    service = get_service(request)

    def run() -> R:
        with service.maps.use_map(name) as opened:
            return job(opened.path, opened.content.topomap)

    return await service.run_job(request, run)


def _check_is_file(service: Service, name: str) -> None:
    """Raise RequestError for a tile of an atlas, whose file may be a copy."""
    for atlas in service.maps.atlases:
        if any(tile.tile_id == name for tile in atlas.now().manifest.tiles):
            raise RequestError(409, "notes are kept beside single map files, not beside tiles")
