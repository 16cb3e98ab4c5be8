"""Lock a map file, so that one process at a time replaces it. The lock ends with the process."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from topoloc.errors import MapError
from topoloc.recordings.file_locks import close, open_to_lock, wait_for_lock

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


@contextmanager
def no_edit_of(path: Path, on_wait: WaitCallback | None) -> Iterator[None]:
    """Wait until no other edits the map at `path`, and keep others from it meanwhile. A missing or
    unreadable file is not locked. Raises MapError if this thread edits the map."""
    with ExitStack() as stack:
        if os.path.isfile(path):
            with suppress(OSError):
                stack.enter_context(lock_map_file(path, on_wait))
        yield
