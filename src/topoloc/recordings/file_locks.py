"""Lock, replace and synchronize files, on POSIX systems and on Windows.

Windows has no `flock`, opens no folder, and replaces no file that is open. So no file is held open
there: of two writers at once the last one wins, and temporary files of killed writers stay.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None


def has_locks() -> bool:
    """Return whether the system can lock files, and replace open ones. It does not on Windows."""
    return fcntl is not None


def open_to_lock(path: Path, flags: int = os.O_RDONLY) -> tuple[int, os.stat_result]:
    """Open a file or a folder. Return its descriptor and its status. Without locks it is closed
    again, and the descriptor is -1. Raises OSError."""
    if fcntl is None and path.is_dir():
        return -1, path.stat()
    descriptor = os.open(path, flags, 0o666)
    status = os.fstat(descriptor)
    if fcntl is None:
        os.close(descriptor)
    return -1 if fcntl is None else descriptor, status


def close(descriptor: int) -> None:
    """Close a descriptor of `open_to_lock`, which frees its lock."""
    if descriptor >= 0:
        os.close(descriptor)


def try_lock(descriptor: int) -> bool | None:
    """Lock an open file. Return False if another process has the lock, None without locks."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return None
    return True


def lock_new(descriptor: int) -> bool:
    """Lock a new file. Return False if another process has removed it as stale."""
    is_ours = try_lock(descriptor) is not False
    return is_ours and (descriptor < 0 or os.fstat(descriptor).st_nlink > 0)


def wait_for_lock(descriptor: int, on_wait: Callable[[], None] | None = None) -> None:
    """Lock an open file. Call `on_wait` before waiting for another process."""
    if try_lock(descriptor) is False and fcntl is not None:
        if on_wait is not None:
            on_wait()
        fcntl.flock(descriptor, fcntl.LOCK_EX)


def replace(source: Path, target: Path) -> None:
    """Rename a file over another. On Windows wait a little for who has it open. Raises OSError."""
    waits_s = iter((0.01, 0.03, 0.1, 0.3, 1.0))
    while True:
        try:
            os.replace(source, target)
            return
        except PermissionError as error:
            if has_locks():
                raise
            if (wait_s := next(waits_s, None)) is None:
                reason = "another program has it open, or it is read-only; close that program"
                raise PermissionError(error.errno, reason, str(target)) from None
        time.sleep(wait_s)


def fsync(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk."""
    if has_locks() or not path.is_dir():  # Windows synchronizes no folder
        descriptor = os.open(path, os.O_RDONLY if has_locks() else os.O_RDWR)
        with suppress(OSError):  # not supported by this file system, whose rename is still atomic
            os.fsync(descriptor)
        os.close(descriptor)
