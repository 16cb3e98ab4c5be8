"""Store an atlas in an object store by obstore: `s3://`, `gs://`, `az://`, `file://`, `memory:///`.

Object stores have no locks and no rename. So each manifest is an object of its own,
`manifests/000000012.json`, and is created only if it does not exist. If two writers create number
12, one succeeds and the other starts again. The manifest with the largest number is the current
one. The store must refuse to create an object that exists (`If-None-Match: *`).
"""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Hashable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from topoloc import AtlasError, MissingExtraError, ObjectStoreError
from topoloc.plugin import atomic_write, cache_folder

_MANIFESTS, _NUM_KEPT = "manifests", 16
CLIENT = {"connect_timeout": "5s", "read_timeout": "30s", "timeout": "1h", "allow_http": True}
RETRIES = {"max_retries": 1}
"""Time limits of a request, and how often it is repeated. A store that does not respond is given up
after about a minute. `timeout` bounds the transfer of a whole file."""


class ObjectStore:
    """Store an atlas below a prefix of an object store. The cache folder of this machine keeps its
    files by their checksums. Raises MissingExtraError: obstore is not installed; AtlasError:
    obstore does not know such a store, or its configuration is not valid."""

    def __init__(self, where: str) -> None:
        self.where = where.rstrip("/")
        try:
            with MissingExtraError.on_import(f"{where}: object stores need {{}}", "cluster"):
                self._objects = open_objects(self.where)
        except MissingExtraError:
            raise
        except Exception as error:  # each client has its own errors
            raise AtlasError(f"{where}: {_format_error(error)}") from error

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
            if not self._create_object(f"{_MANIFESTS}/{number:09d}.json", after):
                return False
            for name in names[:-_NUM_KEPT]:
                self.remove(name)
        return True

    def _create_object(self, name: str, data: bytes) -> bool:
        """Create an object. Return False if another writer was faster. An object with the same
        bytes is this writer's own: the client repeats a request whose response was lost."""
        from obstore.exceptions import AlreadyExistsError, PreconditionError

        try:
            self._objects.put(name, data, mode="create")
        except (AlreadyExistsError, PreconditionError):
            with suppress(FileNotFoundError):  # the other writer has not finished
                return self._read(name) == data
            return False
        return True

    def put(self, name: str, path: Path) -> None:
        with self._translate_errors():
            self._objects.put(name, path, max_concurrency=1)

    def local_path(self, name: str, sha256: str) -> Path:
        cached = self.cached(name, sha256)
        if cached is not None:
            return cached
        path = _cache_path(name, sha256)
        with _cache_file(path) as temporary, self._translate_errors():
            try:
                with temporary.open("wb") as file:
                    file.writelines(self._objects.get(name).stream())
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
            # The access time is the time of the last use. The file stays the same.
            os.utime(path, ns=(time.time_ns(), path.stat().st_mtime_ns))
        except OSError:
            return path if path.is_file() else None
        return path

    def ages(self, folder: str) -> dict[str, float]:
        now = time.time()
        with self._translate_errors():
            return {
                one["path"]: now - one["last_modified"].timestamp()
                for one in self._objects.list(folder).collect()
            }

    def remove(self, name: str) -> None:
        with self._translate_errors(), suppress(FileNotFoundError):  # another writer removed it
            self._objects.delete(name)

    def _latest(self) -> tuple[list[str], bytes | None]:
        """Return the names of all manifests and the content of the newest. Repeat if it was removed
        between listing and reading."""
        for _ in range(3):
            names = self._manifests()
            with suppress(FileNotFoundError):
                return names, self._read(names[-1]) if names else None
        raise AtlasError(f"{self.where} is written faster than it can be read")

    def _manifests(self) -> list[str]:
        names = [Path(one["path"]) for one in self._objects.list(_MANIFESTS).collect()]
        return sorted(str(one) for one in names if one.suffix == ".json" and one.stem.isdecimal())

    def _read(self, name: str) -> bytes:
        return bytes(self._objects.get(name).bytes())

    @contextmanager
    def _translate_errors(self) -> Iterator[None]:
        """Convert any error of a client to ObjectStoreError."""
        try:
            yield
        except AtlasError:
            raise
        except Exception as error:
            raise ObjectStoreError(
                f"{self.where} does not answer, or not as a store: {_format_error(error)}"
            ) from error


@lru_cache(maxsize=32)
def open_objects(where: str) -> Any:
    """Return the client of a store. Keys and address come from the environment, or from boto3 if it
    is installed. All users of an address share its client."""
    from obstore.store import from_url

    scheme = where.partition("://")[0]
    remote: dict[str, Any] = {"client_options": CLIENT, "retry_config": RETRIES}
    options = {"memory": {}, "file": {"mkdir": True}}.get(scheme, remote)
    if scheme in ("s3", "s3a"):
        with suppress(ImportError, ValueError):  # ValueError: boto3 has no keys
            from obstore.auth.boto3 import Boto3CredentialProvider

            options["credential_provider"] = Boto3CredentialProvider()
    return from_url(where, **options)


def _format_error(error: Exception) -> str:
    """Return the text of an error in one line, without the part that obstore adds for debugging."""
    text = str(error).partition("Debug source:")[0]
    return " ".join(text.split())[:400] or type(error).__name__


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _cache_path(name: str, sha256: str) -> Path:
    return cache_folder() / "tiles" / f"{sha256}{Path(name).suffix}"


@contextmanager
def _cache_file(path: Path) -> Iterator[Path]:
    """Yield a new file in the cache folder. Raises ObjectStoreError if it cannot be written."""
    with ObjectStoreError.at(f"cannot keep {path}", OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as temporary:
            yield temporary
