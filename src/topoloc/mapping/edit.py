"""Edit a map file in named and dated transactions, and undo the last edits to byte-identical files.

An edit replaces the whole file. Readers keep the file they opened. A killed process leaves the map
before or after its edit.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from topoloc.errors import MapError
from topoloc.mapping.storage.entries import Edit, today
from topoloc.mapping.storage.kept_files import (
    WaitCallback,
    find_fault,
    find_kept_files,
    lock_map_file,
    warn_of_damage,
)
from topoloc.mapping.storage.map_writing import replace_file
from topoloc.mapping.storage.schema import SCHEMA_VERSION
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.mapping.validation import describe_failure
from topoloc.recordings.atomic import fsync, replace as rename

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
        named = replace(changed, edits=[*edits, edit])
        kept = replace_file(named, self.path, check=self.check_still_locked)
        # The newest was read just now. Of the older ones the next alone is read: all together have
        # up to `_MAX_BYTES`. `read_history` reads all, and `undo_edit` the one that it restores.
        warn_of_damage(kept[1:2])
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
            rename(kept[0], edit.path)
        except OSError as error:
            raise MapError(f"cannot write map {path}: {describe_failure(error)}") from error
        with suppress(OSError):  # no handle is left: the file is in place
            fsync(edit.path.parent)
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


def _explain_missing(path: Path, last: Edit | None) -> str:
    """Return the reason why no file is kept from before the last edit."""
    if last is None or last.edit_id <= 1:
        return "it is as built"
    old = path.with_name(f"{path.name}.undo")
    if old.exists():
        return f"{old} is of an older topoloc, and only that version can undo with it"
    return f"the file before {last.name!r} is not kept"
