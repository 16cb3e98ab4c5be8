"""Write files and folders atomically.

A reader sees the old file or the new one, and a failure leaves nothing behind. Data is written to a
temporary file of a unique name beside the target. It is renamed over the target when it is complete
and on the disk. The writer holds a lock on the temporary file, which ends with its process. A
temporary file without a lock is stale, and the next writer of the same target removes it. Several
writers do not interfere, even from different containers. The last one wins.

Windows has no `flock`, opens no folder, and replaces no file that is open. So no file is held open
there: of two writers at once the last one wins, and temporary files of killed writers stay.
"""

from __future__ import annotations

import glob
import os
import secrets
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from hashlib import blake2b
from pathlib import Path

from topoloc.errors import TopolocError

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


_written_paths: ContextVar[list[Path] | None] = ContextVar("written_paths", default=None)


def collect_written_paths() -> list[Path]:
    """Return a list that receives the path of each file and folder that is complete from now on, in
    this context (`contextvars`)."""
    _written_paths.set(paths := [])
    return paths


def write_text(path: Path, text: str) -> None:
    """Write text as UTF-8. Raises TopolocError if the file cannot be written."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: Path, data: bytes) -> None:
    """Write the whole file. Raises TopolocError if it cannot be written."""
    with TopolocError.at(f"cannot write {path}", OSError), atomic_write(path) as temporary:
        temporary.write_bytes(data)


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield an empty file beside `path` to write to.

    It is renamed over `path` if the body succeeds, and removed otherwise.

    Raises:
        OSError: the folder or the file cannot be written.
    """
    path = _resolve_link(path)
    with temporary_file(path) as temporary:
        yield temporary
        fsync(temporary)
        replace(temporary, path)
        _note_written(path)
        with suppress(OSError):  # no handle is left: the file is in place
            fsync(path.parent)


@contextmanager
def temporary_file(path: Path) -> Iterator[Path]:
    """Yield an empty file beside `path` that is removed afterwards.

    Files of killed writers are removed by the next writer. Write into the file itself: a file
    renamed over it would not be locked.

    Raises:
        OSError: the folder cannot be written.
    """
    target = _resolve_link(path)
    remove_stale_files(target)
    temporary, lock = _create_locked_file(target)
    try:
        yield temporary
    finally:
        with suppress(OSError):  # already renamed, or the folder is missing
            temporary.unlink()
        close(lock)


@contextmanager
def temporary_folder(prefix: str) -> Iterator[Path]:
    """Yield a new folder for temporary files that is removed afterwards.

    Its name begins with `prefix`. Unlocked folders of that prefix, left by killed processes, are
    removed first.

    Raises:
        OSError: the folder cannot be created.
    """
    for left in Path(tempfile.gettempdir()).glob(f"{prefix}*"):
        _remove_unlocked(left)
    folder, lock = _create_locked_folder(prefix)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        close(lock)


def write_folder(path: Path, files: Mapping[str, bytes]) -> None:
    """Write a folder with these files, all of it or nothing. File names may contain folders.

    An existing folder is replaced if it holds no other files than the new ones.

    Raises:
        TopolocError: the folder holds other files, or cannot be written.
    """
    path = _resolve_link(path)
    temporary = path.with_name(f"{_temporary_prefix(path)}{secrets.token_hex(8)}.folder")
    before = temporary.with_suffix(".before")
    try:
        _check_replaceable(path, files)
        for name, data in files.items():
            (temporary / name).parent.mkdir(parents=True, exist_ok=True)
            (temporary / name).write_bytes(data)
            fsync(temporary / name)
        if path.is_dir():
            os.rename(path, before)
        os.rename(temporary, path)
        _note_written(path)
        fsync(path.parent)
    except OSError as error:
        if before.is_dir() and not path.exists():
            os.rename(before, path)
        raise TopolocError(f"cannot write {path}: {error.strerror}") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        if path.is_dir():  # else the old folder is the only copy
            shutil.rmtree(before, ignore_errors=True)


def _check_replaceable(path: Path, files: Mapping[str, bytes]) -> None:
    """Check that `path` is not a file and that the folder holds no file that would be lost. Raises
    TopolocError."""
    if path.exists() and not path.is_dir():
        raise TopolocError(f"cannot write {path}: it is no folder")
    for entry in path.rglob("*"):
        name = entry.relative_to(path).as_posix()
        if name not in files and (entry.is_symlink() or not entry.is_dir()):
            raise TopolocError(
                f"cannot write {path}: this folder holds other things, such as {name}"
            )


def _note_written(path: Path) -> None:
    if (paths := _written_paths.get()) is not None:
        paths.append(path)


def _resolve_link(path: Path) -> Path:
    """Return the target of a symbolic link, so that the target is replaced and not the link."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


def remove_stale_files(path: Path) -> None:
    """Remove temporary files of `path` left by killed writers. Files of running processes stay."""
    path = _resolve_link(path)
    remove_all_stale_files(path.parent, _temporary_prefix(path))


def remove_all_stale_files(folder: Path, prefix: str = ".") -> None:
    """Remove temporary files of any target in a folder, left by killed writers. Files of running
    processes stay. `prefix` is that of the files' names."""
    names = sorted(path.name for path in folder.glob(f"{glob.escape(prefix)}*"))
    for name in names:
        if name.endswith(".part"):
            _remove_unlocked(folder / name)
    for name in names:  # journals of SQLite whose temporary file does not exist any more
        owner = name.removesuffix("-journal")
        if owner != name and owner.endswith(".part") and not (folder / owner).exists():
            with suppress(OSError):
                (folder / name).unlink()


def _temporary_prefix(path: Path) -> str:
    """Return the prefix of the names of all temporary files of `path`."""
    return f".{short_name(path)}."


def short_name(path: Path) -> str:
    """Return the name of a file, or a digest of it if a longer name were too long for some file
    systems. Names of files that belong to `path` begin with it."""
    encoded = os.fsencode(path.name)
    if len(encoded) <= 200:
        return path.name
    return blake2b(encoded, digest_size=16).hexdigest()


def _create_locked_file(path: Path) -> tuple[Path, int]:
    """Create an empty file beside `path`. Return it and its descriptor, which holds its lock."""
    while True:
        temporary = path.with_name(f"{_temporary_prefix(path)}{secrets.token_hex(8)}.part")
        descriptor, _ = open_to_lock(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL)
        if lock_new(descriptor):
            return temporary, descriptor
        close(descriptor)
        with suppress(OSError):
            temporary.unlink()


def _create_locked_folder(prefix: str) -> tuple[Path, int]:
    """Create a folder. Return it and its descriptor, which holds its lock."""
    while True:
        folder = Path(tempfile.mkdtemp(prefix=prefix))
        try:
            descriptor, _ = open_to_lock(folder)
        except FileNotFoundError:  # another process removed it as stale
            continue
        if lock_new(descriptor):
            return folder, descriptor
        close(descriptor)


def _remove_unlocked(temporary: Path) -> None:
    """Remove a file, or a folder with its content, unless a writer holds its lock."""
    is_folder = temporary.is_dir()
    try:
        descriptor, _ = open_to_lock(temporary, os.O_RDONLY if is_folder else os.O_RDWR)
    except OSError:  # already removed, or no permission
        return
    try:
        if not try_lock(descriptor):
            return
        if is_folder:
            shutil.rmtree(temporary, ignore_errors=True)
        else:
            with suppress(OSError):
                temporary.unlink()
    finally:
        close(descriptor)
