"""Store the files of an atlas: immutable files, and one manifest with compare-and-swap updates.

In a folder the manifest is `atlas.json`. Writers hold a lock (`flock`, released when the process
ends) and check that the manifest is still the one that they read. A reader sees either the old or
the new manifest, never a part.
"""

from __future__ import annotations

import hashlib
import importlib
import os
import shutil
import time
from collections.abc import Hashable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Protocol, runtime_checkable

from topoloc.atlas.manifest import TILES, Manifest
from topoloc.errors import AtlasError, TopolocError
from topoloc.recordings.atomic import (
    atomic_write,
    close,
    open_to_lock,
    remove_all_stale_files,
    wait_for_lock,
    write_bytes,
)

MANIFEST = "atlas.json"
_LOCK = ".atlas.lock"
_OBJECT_STORES = "topoloc.apps.stores.object_store"
"""Module of `ObjectStore`. It is imported by name, because obstore is an optional extra and the
module belongs to the apps."""


@runtime_checkable
class Store(Protocol):
    """Store files by name, and the manifest. `where` is the address in messages."""

    where: str

    def manifest(self) -> bytes | None:
        """Return the current manifest, None if there is none.

        Raises:
            AtlasError: it cannot be read.
        """
        ...

    def version(self) -> Hashable | None:
        """Return a value that changes with each write of the manifest, None if there is none.

        It is cheaper than reading the manifest.

        Raises:
            AtlasError: it cannot be read.
        """
        ...

    def commit(self, before: bytes | None, after: bytes) -> bool:
        """Replace the manifest if it is still `before`. Otherwise return False and change nothing.

        Raises:
            AtlasError: it cannot be written.
        """
        ...

    def put(self, name: str, path: Path) -> None:
        """Store a copy of a file under a name derived from its contents. An existing file gets age
        0."""
        ...

    def local_path(self, name: str, sha256: str) -> Path:
        """Return a local file with these contents.

        Raises:
            AtlasError: the file is missing or differs.
            ObjectStoreError: the store does not respond.
        """
        ...

    def cached(self, name: str, sha256: str) -> Path | None:
        """Return `local_path` if nothing must be fetched, None otherwise.

        Raises:
            AtlasError: the file is missing.
        """
        ...

    def ages(self, folder: str) -> dict[str, float]:
        """Return the seconds since each file of a folder of the store was stored, by name."""
        ...

    def remove(self, name: str) -> None:
        """Delete a file, if it exists."""
        ...


class FolderStore:
    """Store an atlas in a local or mounted folder."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.where = folder, str(folder)
        self._is_new = not folder.exists()

    def manifest(self) -> bytes | None:
        """See `Store.manifest`."""
        try:
            return (self.folder / MANIFEST).read_bytes()
        except (FileNotFoundError, NotADirectoryError):
            return None
        except (OSError, ValueError) as error:
            raise AtlasError(
                f"cannot read {self.folder / MANIFEST}: {getattr(error, 'strerror', error)}"
            ) from None

    def version(self) -> Hashable | None:
        """See `Store.version`."""
        return file_stamp(self.folder / MANIFEST)

    def commit(self, before: bytes | None, after: bytes) -> bool:
        """See `Store.commit`."""
        with self._lock():
            if self.manifest() != before:
                return False
            try:
                write_bytes(self.folder / MANIFEST, after)
            except TopolocError as error:
                self._remove_if_empty()
                raise AtlasError(str(error)) from None
            remove_all_stale_files(self.folder / TILES)
        return True

    def put(self, name: str, path: Path) -> None:
        """See `Store.put`."""
        target = self.folder / name
        with AtlasError.at(f"cannot write {target}", OSError):
            target.parent.mkdir(parents=True, exist_ok=True)
            with suppress(FileNotFoundError):
                if target.stat().st_size == path.stat().st_size:
                    os.utime(target)
                    return
            with atomic_write(target) as temporary:
                shutil.copyfile(path, temporary)

    def local_path(self, name: str, sha256: str) -> Path:
        """See `Store.local_path`."""
        path = self.folder / name
        if not path.is_file():
            raise AtlasError(f"{path} is missing")
        return path

    def cached(self, name: str, sha256: str) -> Path | None:
        """See `Store.cached`."""
        return self.local_path(name, sha256)

    def ages(self, folder: str) -> dict[str, float]:
        """See `Store.ages`."""
        now, ages = time.time(), dict[str, float]()
        with suppress(OSError):
            for entry in os.scandir(self.folder / folder):
                if entry.is_file() and not entry.name.startswith("."):
                    ages[f"{folder}/{entry.name}"] = now - entry.stat().st_mtime
        return ages

    def remove(self, name: str) -> None:
        """See `Store.remove`."""
        with suppress(FileNotFoundError):
            (self.folder / name).unlink()
        self._remove_if_empty()

    def _remove_if_empty(self) -> None:
        """Remove a folder that this store has created, if nobody has stored anything in it."""
        if self._is_new and self.version() is None:
            with suppress(OSError):
                if os.path.isdir(self.folder / TILES):
                    (self.folder / TILES).rmdir()
                (self.folder / _LOCK).unlink(missing_ok=True)
                self.folder.rmdir()

    @contextmanager
    def _lock(self) -> Iterator[None]:
        """Hold the writer lock. The operating system frees the lock of a terminated process."""
        with AtlasError.at(f"cannot write {self.folder}", OSError):
            self.folder.mkdir(parents=True, exist_ok=True)
            descriptor, _ = open_to_lock(self.folder / _LOCK, os.O_RDWR | os.O_CREAT)
        try:
            with suppress(OSError):  # without locks, concurrent writers may lose tiles
                wait_for_lock(descriptor)
            yield
        finally:
            close(descriptor)


def store_at(where: str) -> Store:
    """Return the store of an atlas: a folder, or an object store if the address contains `://`.

    Raises:
        AtlasError: the store cannot be opened.
        MissingExtraError: the extra for object stores is not installed.
    """
    if "://" in where:
        return importlib.import_module(_OBJECT_STORES).ObjectStore(where)
    return FolderStore(Path(where))


def find_store(where: str) -> Store | None:
    """Return the store of the atlas in a folder or an object store. None for any other path, which
    is a map file. Raises as `store_at`."""
    is_folder = "://" not in where and os.path.isfile(Path(where) / MANIFEST)
    return store_at(where) if is_folder or "://" in where else None


def read_manifest(store: Store, creates: bool = False) -> tuple[bytes | None, Manifest]:
    """Return the manifest of a store, as bytes and parsed. If there is none and `creates` is set,
    it is an empty one.

    Raises:
        AtlasError: there is no atlas, or it is damaged.
    """
    data = store.manifest()
    if data is not None:
        return data, Manifest.from_bytes(data, f"{store.where}/{MANIFEST}")
    if creates:
        return None, Manifest()
    raise AtlasError(
        f"{store.where} is no atlas: it has no {MANIFEST}; `topoloc atlas create` makes one"
    )


def file_stamp(path: Path) -> tuple[int, int, int] | None:
    """Return a stamp of a file that changes if the file is replaced, its bytes second. None if it
    is missing."""
    with suppress(OSError):
        status = path.stat()
        return status.st_mtime_ns, status.st_size, status.st_ino
    return None


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal digits.

    Raises:
        AtlasError: the file cannot be read.
    """
    with AtlasError.at(f"cannot read {path}", OSError), path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
