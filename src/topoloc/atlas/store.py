"""Where an atlas lies: files that are written once, and one manifest that is replaced only by who
has read the one before.

In a folder the manifest is `atlas.json`. Writers take turns by a lock (`flock`, which ends with its
process) and look, while they hold it, whether the manifest is still the one that they read; a
reader sees the old one or the new one, whole.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import time
from collections.abc import Hashable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Protocol, runtime_checkable

from topoloc.atlas.manifest import TILES
from topoloc.errors import AtlasError, TopolocError
from topoloc.recordings.atomic import atomic_write, remove_all_stale_files, write_bytes

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

MANIFEST = "atlas.json"
_LOCK = ".atlas.lock"


@runtime_checkable
class Store(Protocol):
    """Files by their names, and the manifest; `where` is what people call it."""

    where: str

    def manifest(self) -> bytes | None:
        """As it is now; None where there is none. Raises AtlasError."""
        ...

    def version(self) -> Hashable | None:
        """What is another one after each write of the manifest, and cheaper to ask for; None where
        there is none. Raises AtlasError."""
        ...

    def commit(self, before: bytes | None, after: bytes) -> bool:
        """Replace the manifest, if it is still `before`; else nothing is changed and False
        returned. Raises AtlasError."""
        ...

    def put(self, name: str, path: Path) -> None:
        """Keep a copy of a file under a name that is made of its contents; one that is there
        already counts as written now."""
        ...

    def local_path(self, name: str, sha256: str) -> Path:
        """A file of this machine with these contents. Raises AtlasError where it is missing or
        another, StoreError where nobody answers."""
        ...

    def cached(self, name: str, sha256: str) -> Path | None:
        """As `local_path`, if nothing need be fetched for it; else None. Raises AtlasError where it
        is missing."""
        ...

    def ages(self, folder: str) -> dict[str, float]:
        """Seconds since each file of a folder of the store was put, by the file's name."""
        ...

    def remove(self, name: str) -> None:
        """Let a file go; nothing where it is gone."""
        ...


class FolderStore:
    """A folder of this machine, or one that is mounted."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.where = folder, str(folder)

    def manifest(self) -> bytes | None:
        try:
            return (self.folder / MANIFEST).read_bytes()
        except (FileNotFoundError, NotADirectoryError):
            return None
        except (OSError, ValueError) as error:
            raise AtlasError(
                f"cannot read {self.folder / MANIFEST}: {getattr(error, 'strerror', error)}"
            ) from None

    def version(self) -> Hashable | None:
        with suppress(OSError):
            status = (self.folder / MANIFEST).stat()
            return status.st_mtime_ns, status.st_size, status.st_ino
        return None

    def commit(self, before: bytes | None, after: bytes) -> bool:
        with self._lock():
            if self.manifest() != before:
                return False
            try:
                write_bytes(self.folder / MANIFEST, after)
            except TopolocError as error:
                raise AtlasError(str(error)) from None
            remove_all_stale_files(self.folder / TILES)
        return True

    def put(self, name: str, path: Path) -> None:
        target = self.folder / name
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            with suppress(FileNotFoundError):
                if target.stat().st_size == path.stat().st_size:
                    os.utime(target)
                    return
            with atomic_write(target) as temporary:
                shutil.copyfile(path, temporary)
        except OSError as error:
            raise AtlasError(f"cannot write {target}: {error.strerror}") from error

    def local_path(self, name: str, sha256: str) -> Path:
        path = self.folder / name
        if not path.is_file():
            raise AtlasError(f"{path} is missing")
        return path

    def cached(self, name: str, sha256: str) -> Path | None:
        return self.local_path(name, sha256)

    def ages(self, folder: str) -> dict[str, float]:
        now, ages = time.time(), dict[str, float]()
        with suppress(OSError):
            for entry in os.scandir(self.folder / folder):
                if entry.is_file() and not entry.name.startswith("."):
                    ages[f"{folder}/{entry.name}"] = now - entry.stat().st_mtime
        return ages

    def remove(self, name: str) -> None:
        with suppress(FileNotFoundError):
            (self.folder / name).unlink()

    @contextmanager
    def _lock(self) -> Iterator[None]:
        """One writer at a time; the lock of a process that ended is free."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(self.folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise AtlasError(f"cannot write {self.folder}: {error.strerror}") from None
        try:
            if fcntl is not None:
                with suppress(
                    OSError
                ):  # a file system without locks: then two writers at once may lose one's tiles
                    fcntl.flock(descriptor, fcntl.LOCK_EX)
            yield
        finally:
            os.close(descriptor)


def sha256_of(path: Path) -> str:
    """Of a file, in hexadecimal digits. Raises AtlasError."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise AtlasError(f"cannot read {path}: {error.strerror}") from None
