"""Files written at once or not at all: a reader sees the old file or the new one, and a failure
leaves nothing behind.

What is written goes to a file beside the target, of a name that nobody else has, and is renamed
over it when it is whole and on the disk. Its writer holds a lock on it (`flock`), which ends with
the process however that ends: a temporary file whose lock can be had belongs to nobody, and the
next writer of the same target removes it. Several writers, also of other containers, do not meet;
the last one wins whole.
"""

from __future__ import annotations

import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from hashlib import blake2b
from pathlib import Path

from topoloc.errors import TopolocError

try:
    import fcntl
except ImportError:  # Windows: leftovers stay there
    fcntl = None


def write_text(path: Path, text: str) -> None:
    """Write text as UTF-8. Raises TopolocError where the file cannot be written."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: Path, data: bytes) -> None:
    """Write the whole file. Raises TopolocError where it cannot be written."""
    try:
        with atomic_write(path) as temporary:
            temporary.write_bytes(data)
    except OSError as error:
        raise TopolocError(f"cannot write {path}: {error.strerror}") from error


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """An empty file beside `path` to write to; it is renamed over `path` when all went well, and
    removed when not.

    Raises:
        OSError: the folder or the file cannot be written.
    """
    path = _resolve_link(path)
    remove_stale_files(path)
    temporary, lock = _create_locked_file(path)
    try:
        yield temporary
        _fsync(temporary)
        os.replace(temporary, path)
        _fsync(path.parent)
    finally:
        with suppress(
            OSError
        ):  # renamed already, or the folder is gone: the error that led here says more
            temporary.unlink()
        os.close(lock)


@contextmanager
def temporary_file(path: Path) -> Iterator[Path]:
    """An empty file beside `path` that is removed afterwards; those of writers that were killed are
    removed by the next one.

    It must be written to as it is: what is renamed over it is nobody's.

    Raises:
        OSError: the folder cannot be written.
    """
    target = _resolve_link(path)
    remove_stale_files(target)
    temporary, lock = _create_locked_file(target)
    try:
        yield temporary
    finally:
        with suppress(OSError):
            temporary.unlink()
        os.close(lock)


@contextmanager
def temporary_folder(prefix: str) -> Iterator[Path]:
    """A new folder among this machine's temporary files, its name beginning so, that is removed
    afterwards; those of owners that were killed go, too. Raises OSError where none can be made."""
    for left in Path(tempfile.gettempdir()).glob(f"{prefix}*"):
        _remove_unlocked(left)
    folder, lock = _create_locked_folder(prefix)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def write_folder(path: Path, files: Mapping[str, bytes]) -> None:
    """Write a folder with these files (names may have folders), all of it or nothing.

    A folder that is there already is replaced if it holds no files but such as are written now.

    Raises:
        TopolocError: it holds others, or cannot be written.
    """
    path = _resolve_link(path)
    temporary = path.with_name(f"{_temporary_prefix(path)}{secrets.token_hex(8)}.folder")
    before = temporary.with_suffix(".before")
    try:
        _check_replaceable(path, files)
        for name, data in files.items():
            (temporary / name).parent.mkdir(parents=True, exist_ok=True)
            (temporary / name).write_bytes(data)
            _fsync(temporary / name)
        if path.is_dir():
            os.rename(path, before)
        os.rename(temporary, path)
        _fsync(path.parent)
    except OSError as error:
        if before.is_dir() and not path.exists():
            os.rename(before, path)
        raise TopolocError(f"cannot write {path}: {error.strerror}") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        if path.is_dir():  # else what was there before is all there is
            shutil.rmtree(before, ignore_errors=True)


def _check_replaceable(path: Path, files: Mapping[str, bytes]) -> None:
    """Hold that no file is lost that nobody means to write anew."""
    if path.exists() and not path.is_dir():
        raise TopolocError(f"cannot write {path}: it is no folder")
    found = (
        one.relative_to(path).as_posix()
        for one in path.rglob("*")
        if one.is_symlink() or not one.is_dir()
    )
    other = next((name for name in found if name not in files), None)
    if other is not None:
        raise TopolocError(f"cannot write {path}: this folder holds other things, such as {other}")


def _resolve_link(path: Path) -> Path:
    """Where a symbolic link leads: that file is replaced, not the link."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


def remove_stale_files(path: Path) -> None:
    """Remove what writers of `path` left beside it that were killed; what a living process writes
    stays."""
    path = _resolve_link(path)
    prefix = _temporary_prefix(path)
    try:
        names = [entry.name for entry in os.scandir(path.parent) if entry.name.startswith(prefix)]
    except OSError:  # no such folder: whoever writes there will say so
        return
    parts = {name for name in names if name.endswith(".part")}
    for name in parts:
        _remove_unlocked(path.parent / name)
    for name in names:  # of SQLite, beside a temporary file that is gone
        owner = name.removesuffix("-journal")
        if owner != name and owner.endswith(".part") and not (path.parent / owner).exists():
            with suppress(OSError):
                (path.parent / name).unlink()


def remove_all_stale_files(folder: Path) -> None:
    """Remove what killed writers of whatever file left in a folder; what a living process writes
    stays."""
    try:
        names = [
            entry.name
            for entry in os.scandir(folder)
            if entry.name.startswith(".") and entry.name.endswith(".part")
        ]
    except OSError:
        return
    for name in names:
        _remove_unlocked(folder / name)


def _temporary_prefix(path: Path) -> str:
    """What the names of all temporary files of `path` begin with; short enough for any file
    system."""
    name = (
        path.name
        if len(os.fsencode(path.name)) <= 200
        else blake2b(os.fsencode(path.name), digest_size=16).hexdigest()
    )
    return f".{name}."


def _create_locked_file(path: Path) -> tuple[Path, int]:
    """A new empty file beside `path`, and its descriptor, which holds its lock."""
    while True:
        temporary = path.with_name(f"{_temporary_prefix(path)}{secrets.token_hex(8)}.part")
        descriptor = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        # between these two lines another writer may have taken it for a leftover
        if _try_lock(descriptor) is not False and os.fstat(descriptor).st_nlink > 0:
            return temporary, descriptor
        os.close(descriptor)
        with suppress(OSError):
            temporary.unlink()


def _create_locked_folder(prefix: str) -> tuple[Path, int]:
    """A new folder, and its descriptor, which holds its lock."""
    while True:
        folder = Path(tempfile.mkdtemp(prefix=prefix))
        try:
            descriptor = os.open(folder, os.O_RDONLY)
        except FileNotFoundError:  # another one took it for a leftover
            continue
        if _try_lock(descriptor) is not False and os.fstat(descriptor).st_nlink > 0:
            return folder, descriptor
        os.close(descriptor)


def _remove_unlocked(temporary: Path) -> None:
    """A file, or a folder with all that is in it, unless a writer holds its lock."""
    is_folder = temporary.is_dir()
    try:
        descriptor = os.open(temporary, os.O_RDONLY if is_folder else os.O_RDWR)
    except OSError:  # removed by another writer, or not ours to remove
        return
    try:
        if not _try_lock(descriptor):
            return
        if is_folder:
            shutil.rmtree(temporary, ignore_errors=True)
        else:
            with suppress(OSError):
                temporary.unlink()
    finally:
        os.close(descriptor)


def _try_lock(descriptor: int) -> bool | None:
    """Take the lock of an open file; False where another has it, None where there are no locks."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return None
    return True


def _fsync(path: Path) -> None:
    """Hold until a file, or the names in a folder, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError:  # file systems that cannot; the rename is atomic there, too
        pass
    finally:
        os.close(descriptor)
