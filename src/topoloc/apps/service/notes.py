"""Notes at places of a map, in a file beside it. The map itself is not written."""

from __future__ import annotations

import json
import threading
import uuid
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct, to_builtins

from topoloc import Rigid3, TopolocError, TopoMetricMap
from topoloc.apps.service.protocols.geopose_messages import GeoPoseOgc, Position, Quaternion
from topoloc.apps.service.request_errors import RequestError
from topoloc.plugin import Finite, decode_json, write_text

MAX_TEXT = 500
"""Characters of a note."""
_MAX_DISTANCE_M = 1000.0  # of a note from the nearest node
_SUFFIX = ".notes.json"
_Point = Annotated[list[Finite], Meta(min_length=3, max_length=3)]


class Note(Struct, frozen=True):
    """A note. Its position in the map's world (metres) is that of `point_cam`, which lies in the
    axes of a node, so that the note moves with the map when an edit moves it."""

    id: str
    text: Annotated[str, Meta(min_length=1, max_length=MAX_TEXT)]
    created: str
    position: _Point
    node: int
    point_cam: _Point


class _NotesFile(Struct, frozen=True):
    map: str
    notes: list[Note]
    format: str = "topoloc-notes"
    version: int = 1


class NoteFiles:
    """The notes of all maps of a service, at most `max_notes` of each."""

    def __init__(self, max_notes: int) -> None:
        self._max_notes, self._lock = max_notes, threading.Lock()

    def list_notes(self, path: Path, topomap: TopoMetricMap) -> list[dict[str, Any]]:
        """Return the notes of the map in this file as JSON, the oldest first. Raises RequestError:
        their file is damaged."""
        file = _read(path)
        notes = file.notes if file and file.map == topomap.id else []
        if not notes:
            return []
        poses: dict[int, Rigid3] = {one.node_id: one.world_from_cam for one in topomap.summaries}
        found = list[dict[str, Any]]()
        for note in notes:
            pose = poses.get(note.node)
            position = note.position if pose is None else pose.apply(np.array(note.point_cam))
            shown = {"id": note.id, "text": note.text, "created": note.created}
            found.append(shown | {"position": [float(value) for value in position]})
            if topomap.georeference is not None:
                place = Position(**asdict(topomap.georeference.geopoint(np.array(position))))
                upright = Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)
                found[-1]["geopose"] = GeoPoseOgc(position=place, quaternion=upright).model_dump()
        return found

    def add(self, path: Path, topomap: TopoMetricMap, text: str, position: list[float]) -> str:
        """Add a note and return its id. Raises RequestError: it lies outside the map, there are too
        many notes, or the file cannot be used."""
        centres = np.array([one.world_from_cam.translation for one in topomap.summaries])
        distances = np.linalg.norm(centres - np.array(position), axis=1)
        if not distances.min() <= _MAX_DISTANCE_M:
            raise RequestError(
                422, f"position: it is more than {_MAX_DISTANCE_M:g} m away from the map"
            )
        node = topomap.summaries[int(distances.argmin())]
        point = node.world_from_cam.inverse().apply(np.array(position)).tolist()
        created = datetime.now(UTC).isoformat(timespec="seconds")
        note = Note(uuid.uuid4().hex, text, created, position, node.node_id, point)
        with self._lock:
            notes = self._editable(path, topomap)
            if len(notes) >= self._max_notes:
                fault = f"the map has {len(notes)} notes, and more are not kept; delete some"
                raise RequestError(409, fault if notes else "this service keeps no notes")
            _write(path, _NotesFile(topomap.id, [*notes, note]))
        return note.id

    def remove(self, path: Path, topomap: TopoMetricMap, note_id: str) -> None:
        """Remove a note. Raises RequestError: there is none of this id, or the file cannot be
        used."""
        with self._lock:
            notes = self._editable(path, topomap)
            left = [note for note in notes if note.id != note_id]
            if len(left) == len(notes):
                raise RequestError(404, f"no note {note_id[:40]!r}")
            _write(path, _NotesFile(topomap.id, left))

    def _editable(self, path: Path, topomap: TopoMetricMap) -> list[Note]:
        file = _read(path)
        if file and file.map != topomap.id and file.notes:
            raise RequestError(
                409, f"{_beside(path).name} has the notes of another map; move it away"
            )
        return file.notes if file else []


def _beside(path: Path) -> Path:
    return path.with_name(path.name.removesuffix(".topo") + _SUFFIX)


def _read(path: Path) -> _NotesFile | None:
    file = _beside(path)
    try:
        text = file.read_text(encoding="utf-8")
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "no text"
        raise RequestError(503, f"{file.name} cannot be read: {reason}") from None

    def fault(said: str) -> RequestError:
        return RequestError(503, f"{said}; mend the file, or move it away")

    return decode_json(text, _NotesFile, fault, file.name)


def _write(path: Path, file: _NotesFile) -> None:
    try:
        write_text(_beside(path), json.dumps(to_builtins(file), indent=1) + "\n")
    except TopolocError as error:
        raise RequestError(503, str(error)) from None
