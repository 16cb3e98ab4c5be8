"""Edit a map file in named and dated transactions, and undo the last edits to byte-identical files.

An edit replaces the whole file. Readers keep the file they opened. A killed process leaves the map
before or after its edit.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from topoloc.errors import MapError
from topoloc.mapping.storage.entries import Edit, today
from topoloc.mapping.storage.kept_files import (
    drop_kept_files,
    find_fault,
    find_kept_files,
    keep_file,
    warn_of_damage,
)
from topoloc.mapping.storage.map_lock import WaitCallback, lock_map_file
from topoloc.mapping.storage.map_writing import write_map
from topoloc.mapping.storage.schema import SCHEMA_VERSION
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.mapping.validation import describe_failure
from topoloc.recordings.atomic import atomic_write
from topoloc.recordings.file_locks import fsync, replace as replace_file

_WRITABLE = stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH


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
        """Replace the file by the changed map atomically, with an entry of this name in its
        history. `changes` holds numbers and texts for the history, by name.

        Raises MapError if the map cannot be written, the file before cannot be kept, or another
        process replaced the map. The file at the path stays unchanged. Warns if the kept file of
        the edit before is damaged.
        """
        edits = self.topomap.edits
        edit = Edit(self.topomap.free_ids.edit, name, today(), SCHEMA_VERSION, changes)
        kept = None
        try:
            with atomic_write(self.path) as temporary:
                write_map(replace(changed, edits=[*edits, edit]), temporary)
                fsync(temporary)  # takes long, so it comes before the check
                kept = keep_file(self.path, temporary)
                self.check_still_locked()
        except (OSError, MapError) as error:
            if kept is not None:
                kept.unlink(missing_ok=True)
            if isinstance(error, MapError):
                raise
            raise MapError(f"cannot write map {self.path}: {describe_failure(error)}") from error
        # The newest was read just now. Of the older ones the next alone is read: all together have
        # up to `_MAX_BYTES`. `read_history` reads all, and `undo_edit` the one that it restores.
        warn_of_damage(drop_kept_files(self.path, kept)[1:2])
        return edit

    def check_still_locked(self) -> None:
        """Raise MapError if another file is at the path now, OSError if there is none."""
        if not os.path.samestat(self.locked, self.path.stat()):
            raise MapError(
                f"map {self.path} was replaced during the edit: the new file stays, repeat the edit"
            )


@contextmanager
def edit_map(path: str | Path, on_wait: WaitCallback | None = None) -> Iterator[MapEdit]:
    """Open a map file for an edit. Waits while another process edits it, and calls `on_wait` once
    before.

    Raises MapError if the file is missing, damaged or read-only, MapVersionError if the schema is
    unknown to this version.
    """
    path = Path(os.path.realpath(path))
    with ExitStack() as stack:
        try:
            locked = stack.enter_context(lock_map_file(path, on_wait))
        except (OSError, ValueError) as error:
            raise MapError(f"cannot open map {path}: {describe_failure(error)}") from None
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
            if fault := find_fault(kept[0]):
                raise MapError(fault)
            replace_file(kept[0], edit.path)
        except OSError as error:
            raise MapError(f"cannot write map {path}: {describe_failure(error)}") from error
    return last


def read_history(path: str | Path, num_undoable: int | None = None) -> list[dict[str, Any]]:
    """Return the edits of a map file as JSON, the first one first, each with whether it can be
    undone (`undoable`). Warns of a damaged kept file.

    Args:
        num_undoable: number of edits that can be undone. By default the files are counted that are
            kept beside the map.

    Raises:
        MapError: the map is missing or damaged.
    """
    with TopoMetricMap.load(path) as topomap:
        edits = [asdict(edit) for edit in topomap.edits]
    if num_undoable is None:
        num_undoable = warn_of_damage(find_kept_files(Path(os.path.realpath(path))))
    return [
        edit | {"undoable": number > len(edits) - num_undoable}
        for number, edit in enumerate(edits, start=1)
    ]


def set_look_alike_floors(
    path: str | Path, value: bool, on_wait: WaitCallback | None = None
) -> None:
    """Change `MapConfig.look_alike_floors` of a map file, as one edit. Raises MapError: all images
    are grey, or the map cannot be read or written."""
    with edit_map(path, on_wait) as edit:
        lights = [session.light for session in edit.topomap.sessions]
        if value and lights and all(one and one.red == one.blue == 1.0 for one in lights):
            raise MapError(
                f"map {path} has no colours to tell floors apart: all its images are grey;"
                f" `topoloc update {path} SEQ` adds a recording in colour"
            )
        config = replace(edit.topomap.config, look_alike_floors=value)
        name = f"look-alike floors: {'yes' if value else 'no'}"
        edit.commit(replace(edit.topomap, config=config), name)


def _explain_missing(path: Path, last: Edit | None) -> str:
    """Return the reason why no file is kept from before the last edit."""
    if last is None or last.edit_id <= 1:
        return "it is as built"
    old = path.with_name(f"{path.name}.undo")
    if old.exists():
        return f"{old} is of an older topoloc, and only that version can undo with it"
    return f"the file before {last.name!r} is not kept"
