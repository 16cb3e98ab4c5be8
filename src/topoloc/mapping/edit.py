"""Edit a map file in named and dated transactions, and undo the last edits to byte-identical files.

An edit replaces the whole file. Readers keep the file they opened. A killed process leaves the map
before or after its edit.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from topoloc.errors import MapError
from topoloc.mapping.sessions import Edit, today
from topoloc.mapping.storage.kept_files import (
    drop_kept_files,
    find_kept_files,
    keep_file,
    restore_file,
)
from topoloc.mapping.storage.map_writing import write_map
from topoloc.mapping.storage.schema import SCHEMA_VERSION
from topoloc.mapping.topomap import TopoMetricMap
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
    """Hold a locked map file during an edit. `topomap` is the current map, `locked` the status of
    its file."""

    path: Path
    topomap: TopoMetricMap
    locked: os.stat_result

    def commit(
        self, changed: TopoMetricMap, name: str, changes: Mapping[str, Any] | None = None
    ) -> Edit:
        """Replace the file by the changed map atomically, with an entry in its history.

        Args:
            changed: the changed map.
            name: the name of the edit.
            changes: numbers and texts for the history, by name.

        Raises:
            MapError: the map cannot be written, the file before cannot be kept, or another process
                replaced the map. The file at the path stays unchanged.
        """
        edits = self.topomap.edits
        edit = Edit(self.topomap.free_ids.edit, name, today(), SCHEMA_VERSION, changes)
        kept = None
        try:
            with atomic_write(self.path) as temporary:
                write_map(replace(changed, edits=[*edits, edit]), temporary)
                self.check_still_locked()
                kept = keep_file(self.path, temporary)
        except OSError as error:
            if kept is not None:
                kept.unlink(missing_ok=True)
            raise MapError(f"cannot write map {self.path}: {error.strerror}") from error
        drop_kept_files(self.path)
        return edit

    def check_still_locked(self) -> None:
        """Raise MapError if another file is at the path now, OSError if there is none."""
        if not os.path.samestat(self.locked, self.path.stat()):
            raise MapError(
                f"map {self.path} was replaced during the edit: the new file stays, repeat the edit"
            )


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
    with _lock_map_file(path, on_wait) as locked:
        if (
            not os.access(path, os.W_OK) or not path.stat().st_mode & _WRITABLE
        ):  # read-only for all, even if root may write
            raise MapError(f"cannot write map {path}: it is read-only")
        with TopoMetricMap.load(path) as topomap:
            yield MapEdit(path, topomap, locked)


def undo_edit(path: str | Path, on_wait: WaitCallback | None = None) -> Edit:
    """Undo the last edit of a map file and return it. The file is byte-identical to the one before.

    Raises:
        MapError: there is nothing to undo, the kept file is damaged, or the map cannot be written.
            The map stays unchanged.
    """
    with edit_map(path, on_wait) as edit:
        last = max(edit.topomap.edits, key=lambda one: one.edit_id, default=None)
        kept = find_kept_files(edit.path)
        if last is None or not kept:
            raise MapError(f"map {path}: nothing to undo: {_explain_missing(edit.path, last)}")
        try:
            edit.check_still_locked()
            restore_file(kept[0], edit.path)
        except OSError as error:
            raise MapError(f"cannot write map {path}: {error.strerror}") from error
    return last


def read_history(path: str | Path, num_undoable: int | None = None) -> list[dict[str, Any]]:
    """Return the edits of a map file as JSON, the first one first, each with whether it can be
    undone (`undoable`).

    Args:
        num_undoable: number of edits that can be undone. By default the files are counted that are
            kept beside the map.

    Raises:
        MapError: the map is missing or damaged.
    """
    with TopoMetricMap.load(path) as topomap:
        edits = [asdict(edit) for edit in topomap.edits]
    if num_undoable is None:
        num_undoable = len(find_kept_files(Path(os.path.realpath(path))))
    return [
        edit | {"undoable": number > len(edits) - num_undoable}
        for number, edit in enumerate(edits, start=1)
    ]


def _explain_missing(path: Path, last: Edit | None) -> str:
    """Return the reason why no file is kept from before the last edit."""
    if last is None or last.edit_id <= 1:
        return "it is as built"
    old = path.with_name(f"{path.name}.undo")
    if old.exists():
        return f"{old} is of an older topoloc, and only that version can undo with it"
    return f"the file before {last.name!r} is not kept"


@contextmanager
def _lock_map_file(path: Path, on_wait: WaitCallback | None) -> Iterator[os.stat_result]:
    """Lock the file at `path` and yield its status. Repeats if the previous owner of the lock
    replaced the file."""
    while True:
        try:
            descriptor = os.open(path, os.O_RDONLY)
        except (OSError, ValueError) as error:
            raise MapError(f"cannot open map {path}: {getattr(error, 'strerror', error)}") from None
        try:
            _wait_for_lock(descriptor, on_wait)
            locked = os.fstat(descriptor)
            if path.exists() and os.path.samestat(locked, path.stat()):
                yield locked
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
