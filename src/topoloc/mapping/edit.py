"""Edits of a map file: each is one transaction with a name and a date, and the last ones can be
taken back, to the byte.

The file is replaced whole: whoever reads it keeps what he opened, and a process that is killed
leaves the map before its edit or the one after it.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from topoloc.errors import MapError
from topoloc.mapping.file import MapFile
from topoloc.mapping.schema import SCHEMA_VERSION, TABLES
from topoloc.mapping.sessions import Edit, today
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.mapping.undo_log import add_entry, drop_entries, entries_for, path_of_log, write_before
from topoloc.mapping.writing import digest_of, write_map
from topoloc.recordings.atomic import replaced_file

try:
    import fcntl
except ImportError:  # Windows: of two edits at once the last one wins whole
    fcntl = None

_WRITABLE = stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH

Waits = Callable[[], None]
"""Called where another process edits the map, before this one waits for it."""


@dataclass(frozen=True, eq=False)
class MapEdit:
    """A map file that nobody else edits while this is open; `topomap` is the map as it is."""

    path: Path
    topomap: TopoMetricMap

    def commit(
        self, changed: TopoMetricMap, name: str, changes: Mapping[str, Any] | None = None
    ) -> Edit:
        """Replace the file by the changed map, at once or not at all, with an entry in its history.

        Args:
            changes: what the history tells of this edit: numbers and texts by their names.

        Raises:
            MapError: the map or its undo file cannot be written; the map is as it was.
        """
        edits = self.topomap.edits
        edit = Edit(self.topomap.free_ids.edit, name, today(), SCHEMA_VERSION, changes)
        try:
            with replaced_file(self.path) as temporary:
                write_map(replace(changed, edits=[*edits, edit]), temporary)
                add_entry(self.path, temporary)
        except OSError as error:
            raise MapError(f"cannot write map {self.path}: {error.strerror}") from error
        return edit


@contextmanager
def editing(path: str | Path, waits: Waits | None = None) -> Iterator[MapEdit]:
    """A map file to edit; while another process edits it, this one waits.

    Raises:
        MapError: missing, damaged, or not to be written.
        MapVersionError: of a schema that this version does not know.
    """
    path = Path(os.path.realpath(path))
    with _locked(path, waits):
        if (
            not os.access(path, os.W_OK) or not path.stat().st_mode & _WRITABLE
        ):  # nobody's to write, though root may
            raise MapError(f"cannot write map {path}: it is read-only")
        with TopoMetricMap.load(path) as topomap:
            yield MapEdit(path, topomap)


def undo_edit(path: str | Path, waits: Waits | None = None) -> Edit:
    """Take the last edit of a map file back, to the byte; it is what is returned.

    Raises:
        MapError: there is nothing to take back; the undo file is damaged; the map cannot be
            written. The map is as it was.
    """
    with editing(path, waits) as edit:
        assert edit.topomap.file is not None, "a map that was just opened"
        last = max(edit.topomap.edits, key=lambda one: one.edit_id, default=None)
        entries = entries_for(path_of_log(edit.path), edit.topomap.file.digest)
        if last is None or not entries:
            why = (
                "it is as built"
                if last is None or last.edit_id <= 1
                else f"what was before {last.name!r} is not kept"
            )
            raise MapError(f"map {path}: nothing to undo: {why}")
        try:
            with replaced_file(edit.path) as temporary:
                write_before(edit.path, entries[0], temporary)
                _check(temporary, entries[0].before, path_of_log(edit.path))
            drop_entries(edit.path, entries[0].depth)
        except OSError as error:
            raise MapError(f"cannot write map {path}: {error.strerror}") from error
    return last


def undoable_edits(path: str | Path, log: Path | None = None) -> int:
    """How many of the last edits of a map file can be taken back, by the undo file beside it or
    another one. Raises MapError."""
    path = Path(os.path.realpath(path))
    with closing(MapFile(path)) as file:
        return len(entries_for(log or path_of_log(path), file.digest))


@contextmanager
def _locked(path: Path, waits: Waits | None) -> Iterator[None]:
    """The lock of the file that is at `path`: who had it may have put another file there."""
    while True:
        try:
            descriptor = os.open(path, os.O_RDONLY)
        except (OSError, ValueError) as error:
            raise MapError(f"cannot open map {path}: {getattr(error, 'strerror', error)}") from None
        try:
            _wait_for_lock(descriptor, waits)
            if path.exists() and os.path.samestat(os.fstat(descriptor), path.stat()):
                yield
                return
        finally:
            os.close(descriptor)


def _wait_for_lock(descriptor: int, waits: Waits | None) -> None:
    if fcntl is None:
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        if waits is not None:
            waits()
        fcntl.flock(descriptor, fcntl.LOCK_EX)
    except OSError:  # a file system without locks
        return


def _check(file_before: Path, digest: str, log: Path) -> None:
    """Hold that an undone map is the one that it should be, row by row."""
    with closing(MapFile(file_before)) as file:
        rows = (
            digest
            if file.version == 1
            else digest_of({table: file.checksums(table) for table in TABLES})
        )
        if not digest == rows == file.digest:
            raise MapError(
                f"{log} is damaged: it does not lead back to the map before; the map stays as it is"
            )
