"""Lock a map file, so that one process at a time replaces it. Keep the files that edits of a map
replaced, so that the edits can be undone. The lock ends with the process.

`lab.topo.undo-AFTER-BEFORE` is the file that an edit replaced: a hard link, or a copy where links
do not work. AFTER and BEFORE are digests of the map file after and before this edit. So the names
alone lead back from edit to edit. The map does not need these files otherwise.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import accumulate
from pathlib import Path
from typing import TypeVar

from topoloc.errors import MapError
from topoloc.mapping.validation import describe_failure
from topoloc.recordings.atomic import (
    atomic_write,
    close,
    fsync,
    has_locks,
    open_to_lock,
    short_name,
    wait_for_lock,
)

T = TypeVar("T")

WaitCallback = Callable[[], None]
"""Called before waiting for another process that edits the map."""
_owners = dict[tuple[int, int], int]()
"""The thread that holds the lock of a file, by device and inode."""


@contextmanager
def lock_map_file(path: Path, on_wait: WaitCallback | None) -> Iterator[os.stat_result]:
    """Lock the file at `path` and yield its status. Repeats if the previous owner of the lock
    replaced the file. Raises OSError if it cannot be opened, MapError if this thread edits it."""
    while True:
        descriptor, locked = open_to_lock(path)
        try:
            key = locked.st_dev, locked.st_ino
            if _owners.get(key) == threading.get_ident():
                raise MapError(f"map {path} is being edited by this thread: commit that edit first")
            wait_for_lock(descriptor, on_wait)
            if path.exists() and os.path.samestat(locked, path.stat()):
                _owners[key] = threading.get_ident()
                try:
                    yield locked
                finally:
                    del _owners[key]
                return
        finally:
            close(descriptor)


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


def find_fault(kept: Path) -> str | None:
    """Return why a kept file cannot be restored, with the remedy, None if it can."""
    try:
        is_same = _digest_of(kept)[:16] == kept.name[-16:]
    except OSError as error:
        return f"cannot read {kept}: {describe_failure(error)}"
    text = "is damaged: it is not the map before the edit. Remove it; the map stays as it is"
    return None if is_same else f"{kept} {text}"


def warn_of_damage(kept: Sequence[Path]) -> int:
    """Warn of the first damaged one of the kept files. Return the number of files before it."""
    for row, one in enumerate(kept):
        if fault := find_fault(one):
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
