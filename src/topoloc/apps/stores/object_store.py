"""An atlas in an object store, by fsspec: `s3://`, `gs://`, `memory://` and whatever else it knows.

Object stores have no locks and no rename. So each manifest is an object of its own,
`manifests/000000012.json`, which is created only if it is not there yet: of two writers that make
number 12 one succeeds, and the other begins anew. The newest one counts. That holds where the store
refuses to create what exists (`If-None-Match: *`: Amazon S3 and stores that follow it) and lists
what was written. Where fsspec looks first and writes then, two writers in the same instant may lose
one's tiles.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Hashable, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from topoloc import AtlasError, MissingExtraError, ObjectStoreError
from topoloc.plugin import atomic_write, cache_folder

_MANIFESTS, _NUM_KEPT = "manifests", 16
S3_TRIES, S3_CLIENT = (
    2,
    {"connect_timeout": 5.0, "read_timeout": 15.0, "retries": {"total_max_attempts": 2}},
)
"""Seconds that S3 is waited for, and how often it is asked again: a store that is silent is given
up after a minute, not after minutes."""


class ObjectStore:
    """A prefix of an object store; its files are kept in the cache folder of this machine, by their
    checksums.

    Raises:
        MissingExtraError: fsspec, or what it needs for this kind of store, is not installed.
        AtlasError: fsspec knows no such store.
    """

    def __init__(self, where: str) -> None:
        try:
            import fsspec
        except ModuleNotFoundError as error:
            raise MissingExtraError(
                f"{where}: object stores need {error.name}: pip install 'topoloc[cluster]'"
            ) from error
        self.where = where.rstrip("/")
        try:
            self._files, self._root = fsspec.core.url_to_fs(
                self.where, use_listings_cache=False, **_options(fsspec, self.where)
            )
        except ImportError as error:
            raise MissingExtraError(f"{where}: {' '.join(str(error).split())[:200]}") from error
        except ValueError as error:
            raise AtlasError(f"{where}: {' '.join(str(error).split())[:200]}") from error
        if _is_s3(fsspec, self.where):
            self._files.retries = S3_TRIES

    def manifest(self) -> bytes | None:
        with self._translate_errors():
            return self._latest()[1]

    def version(self) -> Hashable | None:
        with self._translate_errors():
            names = self._manifests()
        return names[-1] if names else None

    def commit(self, before: bytes | None, after: bytes) -> bool:
        with self._translate_errors():
            names, newest = self._latest()
            if newest != before:
                return False
            number = int(Path(names[-1]).stem) + 1 if names else 1
            if not self._create_object(f"{self._root}/{_MANIFESTS}/{number:09d}.json", after):
                return False
            for name in names[:-_NUM_KEPT]:
                self.remove(f"{_MANIFESTS}/{Path(name).name}")
        return True

    def _create_object(self, name: str, data: bytes) -> bool:
        """Create an object; False where another writer was faster. One that holds these very bytes
        is ours: the client asks again where an answer was lost."""
        try:
            self._files.pipe_file(name, data, mode="create")
        except FileExistsError:
            return self._files.cat_file(name) == data
        except OSError as error:
            if (
                "ConditionalRequestConflict" not in f"{error} {error.__cause__}"
            ):  # S3, while another one is writing
                raise
            return False
        return True

    def put(self, name: str, path: Path) -> None:
        with self._translate_errors():
            self._files.put_file(str(path), f"{self._root}/{name}")

    def local_path(self, name: str, sha256: str) -> Path:
        cached = self.cached(name, sha256)
        if cached is not None:
            return cached
        path = _cache_path(name, sha256)
        with _cache_file(path) as temporary, self._translate_errors():
            try:
                self._files.get_file(f"{self._root}/{name}", str(temporary))
            except FileNotFoundError:
                raise AtlasError(f"{self.where}/{name} is missing") from None
            if _sha256(temporary) != sha256:
                raise AtlasError(
                    f"{self.where}/{name} is not the file that was added: its checksum is another"
                )
        return path

    def cached(self, name: str, sha256: str) -> Path | None:
        path = _cache_path(name, sha256)
        try:
            os.utime(
                path, ns=(time.time_ns(), path.stat().st_mtime_ns)
            )  # when it was used last; it is the same file all along
        except OSError:
            return path if path.is_file() else None
        return path

    def ages(self, folder: str) -> dict[str, float]:
        now = time.time()
        with self._translate_errors():
            return {
                f"{folder}/{Path(entry['name']).name}": now - self._modified(entry)
                for entry in self._entries(folder)
            }

    def remove(self, name: str) -> None:
        with self._translate_errors(), suppress(FileNotFoundError):  # another writer was here
            self._files.rm_file(f"{self._root}/{name}")

    def _latest(self) -> tuple[list[str], bytes | None]:
        """The names of all manifests, and what the newest holds. Old ones are removed, also between
        a listing and its reading."""
        for _ in range(3):
            names = self._manifests()
            with suppress(FileNotFoundError):
                return names, self._files.cat_file(names[-1]) if names else None
        raise AtlasError(f"{self.where} is written faster than it can be read")

    def _manifests(self) -> list[str]:
        names = [entry["name"] for entry in self._entries(_MANIFESTS)]
        return sorted(
            name for name in names if Path(name).suffix == ".json" and Path(name).stem.isdecimal()
        )

    def _entries(self, folder: str) -> list[dict[str, Any]]:
        self._files.invalidate_cache()
        try:
            return [
                entry
                for entry in self._files.ls(f"{self._root}/{folder}", detail=True)
                if entry.get("type") == "file"
            ]
        except FileNotFoundError:
            return []

    def _modified(self, entry: dict[str, Any]) -> float:
        """Seconds of Unix time; S3 says it with the names, others are asked."""
        when: Any = entry.get("LastModified") or self._files.modified(entry["name"])
        return when.timestamp() if isinstance(when, datetime) else float(when)

    @contextmanager
    def _translate_errors(self) -> Iterator[None]:
        """Whatever a store's client raises is one failure here: these have errors of their own
        each."""
        try:
            yield
        except (AtlasError, FileExistsError):
            raise
        except Exception as error:
            text = " ".join(str(error).split())[:200] or type(error).__name__
            raise ObjectStoreError(
                f"{self.where} does not answer, or not as a store: {text}"
            ) from error


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _cache_path(name: str, sha256: str) -> Path:
    return cache_folder() / "tiles" / f"{sha256}{Path(name).suffix}"


@contextmanager
def _cache_file(path: Path) -> Iterator[Path]:
    """A file to be, in the cache folder. Raises ObjectStoreError where it cannot be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as temporary:
            yield temporary
    except OSError as error:
        raise ObjectStoreError(f"cannot keep {path}: {error.strerror or error}") from error


def _is_s3(fsspec: Any, where: str) -> bool:
    return fsspec.utils.get_protocol(where) in ("s3", "s3a")


def _options(fsspec: Any, where: str) -> dict[str, Any]:
    """What the store's client is told; what the user's own configuration of fsspec says of it
    counts."""
    if not _is_s3(fsspec, where):
        return {}
    user_config = fsspec.config.conf.get(fsspec.utils.get_protocol(where), {})
    return {"config_kwargs": S3_CLIENT | dict(user_config.get("config_kwargs", {}))}
