"""Keep what was computed of images in a folder of the cache: one build at a time uses it, and old
ones are removed."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from topoloc.apps.core_names import close, open_to_lock, try_lock, wait_for_lock
from topoloc.plugin import cache_folder

_LOCK = "lock"
_MAX_BYTES, _MAX_AGE_S = 1_000_000_000, 30 * 86_400.0  # of all other folders; since the last use


@contextmanager
def open_work_folder(key: str, on_wait: Callable[[], None] | None = None) -> Iterator[Path]:
    """Yield the folder of these images, locked. `on_wait` is called once before waiting for another
    build of the same images. Folders that were not used for long, or do not fit beside newer ones,
    are removed. Raises OSError."""
    folder = cache_folder() / "reconstructions" / key
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor, locked = open_to_lock(folder / _LOCK, os.O_RDWR | os.O_CREAT)
        try:
            with suppress(OSError):  # a file system without locks
                wait_for_lock(descriptor, on_wait)
            if not _is_there(folder / _LOCK, locked):  # removed by another process meanwhile
                continue
            os.utime(folder)
            _remove_old(folder)
            yield folder
            return
        finally:
            close(descriptor)


def _is_there(path: Path, locked: os.stat_result) -> bool:
    try:
        return os.path.samestat(path.stat(), locked)
    except FileNotFoundError:
        return False


def _remove_old(current: Path) -> None:
    """Remove the folders beside this one that are old or too large, and that nobody uses."""
    num_bytes = 0
    others = [one for one in current.parent.iterdir() if one != current and one.is_dir()]
    for folder in sorted(others, key=lambda one: -one.stat().st_mtime):
        num_bytes += sum(one.stat().st_size for one in folder.rglob("*") if one.is_file())
        age_s = time.time() - folder.stat().st_mtime
        if num_bytes <= _MAX_BYTES and age_s <= _MAX_AGE_S:
            continue
        with suppress(OSError):
            descriptor, _ = open_to_lock(folder / _LOCK, os.O_RDWR | os.O_CREAT)
            try:
                if try_lock(descriptor) is not False:
                    shutil.rmtree(folder)
            finally:
                close(descriptor)
