"""Edit a map file in named and dated transactions, and undo the last edits to byte-identical files.

An edit replaces the whole file. Readers keep the file they opened. A killed process leaves the map
before or after its edit.

`lab.topo.undo-AFTER-BEFORE` is the file that an edit replaced: a hard link, or a copy where links
do not work. AFTER and BEFORE are digests of the map file after and before this edit. So the names
alone lead back from edit to edit. The map does not need these files otherwise.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import stat
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from itertools import accumulate
from pathlib import Path
from typing import Any, TypeVar

from topoloc.errors import MapError
from topoloc.mapping.sessions import Edit, today
from topoloc.mapping.storage.map_lock import WaitCallback, lock_map_file, no_edit_of
from topoloc.mapping.storage.map_writing import write_map
from topoloc.mapping.storage.schema import SCHEMA_VERSION
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.mapping.validation import describe_failure
from topoloc.recordings.atomic import atomic_write, short_name
from topoloc.recordings.file_locks import fsync, has_locks, replace as replace_file

T = TypeVar("T")
_MAX_BYTES = 1_000_000_000
"""Bytes of all kept files of a map together. The newest file is kept at any size."""


def kept_path(path: Path, after: str, before: str) -> Path:
    """Return the path of the file that an edit of the map at `path` replaced. `after` and `before`
    are the SHA-256 of the map file after and before the edit, in hexadecimal digits."""
    return path.with_name(f"{short_name(path)}.undo-{after[:16]}-{before[:16]}")


def find_kept_files(path: Path) -> list[Path]:
    """Return the kept files that lead back from the map file at `path`, the newest first. Raises
    MapError if the map file or its folder cannot be read."""
    try:
        found = _find_by_digest(path)
        return _find_chain(found, _digest_of(path)[:16] if found else "")
    except OSError as error:
        raise MapError(f"cannot read map {path}: {describe_failure(error)}") from error


def _find_chain(found: Mapping[str, Path], digest: str) -> list[Path]:
    """Return those of the kept files that lead back from the map of this digest, the newest first.
    `found` has them by the digest of the map after the edit."""
    kept, found = list[Path](), dict(found)
    while digest in found:
        kept.append(found.pop(digest))
        digest = kept[-1].name[-16:]
    return kept


def keep_file(path: Path, changed: Path) -> Path:
    """Keep the file at `path` on the disk, before `changed` is renamed over it. Return the kept
    file. Raises OSError."""
    kept = kept_path(path, _digest_of(changed), _digest_of(path))
    kept.unlink(missing_ok=True)
    with suppress(OSError):  # a file system without links
        if has_locks():  # else the link could not be removed while another program reads the map
            os.link(path, kept)
    if not kept.exists():
        with atomic_write(kept) as temporary:
            shutil.copyfile(path, temporary)
    with suppress(OSError):  # no handle is left: the file is in place
        fsync(path.parent)
    return kept


def _find_fault(kept: Path) -> str | None:
    """Return why a kept file cannot be restored, with the remedy, None if it can."""
    try:
        is_same = _digest_of(kept)[:16] == kept.name[-16:]
    except OSError as error:
        return f"cannot read {kept}: {describe_failure(error)}"
    text = "is damaged: it is not the map before the edit. Remove it; the map stays as it is"
    return None if is_same else f"{kept} {text}"


def _warn_of_damage(kept: Sequence[Path]) -> int:
    """Warn of the first damaged one of the kept files. Return the number of files before it."""
    for row, one in enumerate(kept):
        if fault := _find_fault(one):
            warnings.warn(f"no earlier edit can be undone: {fault}", stacklevel=3)
            return row
    return len(kept)


def drop_kept_files(path: Path, newest: Path) -> Sequence[Path]:
    """Remove the files kept of the map at `path` that do not lead back from its `newest` one, and
    the oldest ones beyond `_MAX_BYTES`. A file that cannot be removed stays. Return the others, the
    newest first."""
    used: Sequence[Path] = []
    with suppress(OSError):
        found = _find_by_digest(path)
        kept = _find_chain(found, newest.name[-33:-17])
        used = select_kept(kept, [one.stat().st_size for one in kept])
        for one in set(found.values()).difference(used):
            one.unlink()
    return used


def select_kept(files: Sequence[T], sizes: Sequence[int]) -> Sequence[T]:
    """Return those of the files, the newest first, that have at most `_MAX_BYTES` together. The
    newest is kept at any size."""
    return files[: max(1, sum(total <= _MAX_BYTES for total in accumulate(sizes)))]


def _find_by_digest(path: Path) -> dict[str, Path]:
    """Return all kept files of a map, by the digest of the map after the edit."""
    name = re.compile(rf"{re.escape(short_name(path))}\.undo-([0-9a-f]{{16}})-[0-9a-f]{{16}}")
    found = (name.fullmatch(one) for one in os.listdir(path.parent))
    return {match[1]: path.with_name(match[0]) for match in found if match}


def _digest_of(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


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
        _warn_of_damage(drop_kept_files(self.path, kept)[1:2])
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


def save_map(
    topomap: TopoMetricMap,
    path: Path,
    on_wait: WaitCallback | None = None,
    is_old_kept: bool = True,
) -> None:
    """Write the map to `path` atomically. A reader sees the old map or the new one. A file that is
    replaced is kept, if `is_old_kept`. Waits while another process edits the map at `path`, and
    calls `on_wait` once before.

    Raises:
        MapError: the folder does not exist or cannot be written, the disk is full, or this thread
            edits the map at `path`. Nothing is left behind.
    """
    if os.path.isdir(path):  # Path.is_dir raises an error for names that are too long
        raise MapError(f"cannot write map {path}: it is a folder")
    kept = None
    try:
        with no_edit_of(path, on_wait), atomic_write(path) as temporary:
            write_map(topomap, temporary)
            if is_old_kept and os.path.isfile(path):
                kept = keep_file(Path(os.path.realpath(path)), temporary)
    except (OSError, ValueError) as error:
        if kept is not None:
            kept.unlink(missing_ok=True)
        # a null character in the name; any other ValueError is a bug
        if isinstance(error, ValueError) and "null" not in str(error):
            raise
        raise MapError(f"cannot write map {path}: {describe_failure(error)}") from error
    if kept is not None:
        drop_kept_files(Path(os.path.realpath(path)), kept)


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
            if fault := _find_fault(kept[0]):
                raise MapError(fault)
            replace_file(kept[0], edit.path)
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
        num_undoable = _warn_of_damage(find_kept_files(Path(os.path.realpath(path))))
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
