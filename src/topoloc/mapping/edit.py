"""Edit a map file in named and dated transactions, and undo the last edits to byte-identical files.

An edit replaces the whole file. Readers keep the file they opened. A killed process leaves the map
before or after its edit.
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
from topoloc.mapping.map_file import MapFile
from topoloc.mapping.map_writing import compute_map_digest, write_map
from topoloc.mapping.schema import SCHEMA_VERSION, TABLES
from topoloc.mapping.sessions import Edit, today
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.mapping.undo_log import (
    add_undo_entry,
    drop_undo_entries,
    find_undo_entries,
    undo_log_path,
    write_previous_map,
)
from topoloc.recordings.atomic import atomic_write

try:
    import fcntl
except ImportError:  # Windows: if two edits run at once, the last one wins
    fcntl = None

_WRITABLE = stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH

WaitCallback = Callable[[], None]
"""Called before waiting for another process that edits the map."""


@dataclass(frozen=True, eq=False)
class MapEdit:
    """Hold a locked map file during an edit. `topomap` is the current map."""

    path: Path
    topomap: TopoMetricMap

    def commit(
        self, changed: TopoMetricMap, name: str, changes: Mapping[str, Any] | None = None
    ) -> Edit:
        """Replace the file by the changed map atomically, with an entry in its history.

        Args:
            changed: the changed map.
            name: the name of the edit.
            changes: numbers and texts for the history, by name.

        Raises:
            MapError: the map or its undo file cannot be written. The map stays unchanged.
        """
        edits = self.topomap.edits
        edit = Edit(self.topomap.free_ids.edit, name, today(), SCHEMA_VERSION, changes)
        try:
            with atomic_write(self.path) as temporary:
                write_map(replace(changed, edits=[*edits, edit]), temporary)
                add_undo_entry(self.path, temporary)
        except OSError as error:
            raise MapError(f"cannot write map {self.path}: {error.strerror}") from error
        return edit


@contextmanager
def edit_map(path: str | Path, on_wait: WaitCallback | None = None) -> Iterator[MapEdit]:
    """Open a map file for an edit. Waits while another process edits it.

    Args:
        path: the map file.
        on_wait: is called once before waiting.

    Raises:
        MapError: the file is missing, damaged, or read-only.
        MapVersionError: the schema is unknown to this version.
    """
    path = Path(os.path.realpath(path))
    with _lock_map_file(path, on_wait):
        if (
            not os.access(path, os.W_OK) or not path.stat().st_mode & _WRITABLE
        ):  # read-only for all, even if root may write
            raise MapError(f"cannot write map {path}: it is read-only")
        with TopoMetricMap.load(path) as topomap:
            yield MapEdit(path, topomap)


def undo_edit(path: str | Path, on_wait: WaitCallback | None = None) -> Edit:
    """Undo the last edit of a map file and return it. The file is byte-identical to the one before.

    Raises:
        MapError: there is nothing to undo, the undo file is damaged, or the map cannot be written.
            The map stays unchanged.
    """
    with edit_map(path, on_wait) as edit:
        assert edit.topomap.file is not None, "a map that was just opened"
        last = max(edit.topomap.edits, key=lambda one: one.edit_id, default=None)
        entries = find_undo_entries(undo_log_path(edit.path), edit.topomap.file.digest)
        if last is None or not entries:
            why = (
                "it is as built"
                if last is None or last.edit_id <= 1
                else f"what was before {last.name!r} is not kept"
            )
            raise MapError(f"map {path}: nothing to undo: {why}")
        try:
            with atomic_write(edit.path) as temporary:
                write_previous_map(edit.path, entries[0], temporary)
                _check_restored_map(temporary, entries[0].before, undo_log_path(edit.path))
            drop_undo_entries(edit.path, entries[0].depth)
        except OSError as error:
            raise MapError(f"cannot write map {path}: {error.strerror}") from error
    return last


def count_undoable_edits(path: str | Path, log: Path | None = None) -> int:
    """Count the edits of a map file that can be undone, by the undo file beside it or by `log`.
    Raises MapError."""
    path = Path(os.path.realpath(path))
    with closing(MapFile(path)) as file:
        return len(find_undo_entries(log or undo_log_path(path), file.digest))


@contextmanager
def _lock_map_file(path: Path, on_wait: WaitCallback | None) -> Iterator[None]:
    """Lock the file at `path`. Repeats if the previous owner of the lock replaced the file."""
    while True:
        try:
            descriptor = os.open(path, os.O_RDONLY)
        except (OSError, ValueError) as error:
            raise MapError(f"cannot open map {path}: {getattr(error, 'strerror', error)}") from None
        try:
            _wait_for_lock(descriptor, on_wait)
            if path.exists() and os.path.samestat(os.fstat(descriptor), path.stat()):
                yield
                return
        finally:
            os.close(descriptor)


def _wait_for_lock(descriptor: int, on_wait: WaitCallback | None) -> None:
    if fcntl is None:
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        if on_wait is not None:
            on_wait()
        fcntl.flock(descriptor, fcntl.LOCK_EX)
    except OSError:  # a file system without locks
        return


def _check_restored_map(previous_file: Path, digest: str, log: Path) -> None:
    """Check by the digest of its rows that a restored map is the previous one. Raises MapError."""
    with closing(MapFile(previous_file)) as file:
        rows = (
            digest
            if file.version == 1
            else compute_map_digest({table: file.checksums(table) for table in TABLES})
        )
        if not digest == rows == file.digest:
            raise MapError(
                f"{log} is damaged: it does not lead back to the map before; the map stays as it is"
            )
