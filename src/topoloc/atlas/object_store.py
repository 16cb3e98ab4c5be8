"""An atlas in an object store, by fsspec: `s3://`, `gs://`, `memory://` and whatever else it knows.

Object stores have no locks and no rename. So each manifest is an object of its own, `manifests/000000012.json`, which is created only if it
is not there yet: of two writers that make number 12 one succeeds, and the other begins anew. The newest one counts. That holds where the
store refuses to create what exists (`If-None-Match: *`: Amazon S3 and stores that follow it) and lists what was written. Where fsspec looks
first and writes then, two writers in the same instant may lose one's tiles.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from topoloc.atlas.manifest import TILES
from topoloc.atlas.store import sha256_of
from topoloc.errors import AtlasError, MissingExtraError
from topoloc.features.network_files import cache_folder
from topoloc.sequences.atomic import replaced_file

_MANIFESTS, _KEPT = "manifests", 16


class ObjectStore:
    """A prefix of an object store; its files are kept in the cache folder of this machine, by their checksums.

    Raises:
        MissingExtraError: fsspec, or what it needs for this kind of store, is not installed.
        AtlasError: fsspec knows no such store.
    """

    def __init__(self, where: str) -> None:
        try:
            import fsspec
        except ModuleNotFoundError as error:
            raise MissingExtraError(f"{where}: object stores need {error.name}: pip install 'topoloc[cluster]'") from error
        self.where = where.rstrip("/")
        try:
            self._files, self._root = fsspec.core.url_to_fs(self.where)
        except ImportError as error:
            raise MissingExtraError(f"{where}: {' '.join(str(error).split())[:200]}") from error
        except ValueError as error:
            raise AtlasError(f"{where}: {' '.join(str(error).split())[:200]}") from error

    def manifest(self) -> bytes | None:
        with self._told():
            names = self._manifests()
            return self._files.cat_file(names[-1]) if names else None

    def commit(self, before: bytes | None, after: bytes) -> bool:
        with self._told():
            names = self._manifests()
            if (self._files.cat_file(names[-1]) if names else None) != before:
                return False
            number = int(Path(names[-1]).stem) + 1 if names else 1
            try:
                self._files.pipe_file(f"{self._root}/{_MANIFESTS}/{number:09d}.json", after, mode="create")
            except FileExistsError:
                return False
            for name in names[:-_KEPT]:
                self.remove(f"{_MANIFESTS}/{Path(name).name}")
        return True

    def put(self, name: str, path: Path) -> None:
        with self._told():
            self._files.put_file(str(path), f"{self._root}/{name}")

    def local(self, name: str, sha256: str) -> Path:
        path = cache_folder() / "tiles" / f"{sha256}{Path(name).suffix}"
        if path.is_file():
            os.utime(path)
            return path
        with self._told(), _made(path) as temporary:
            self._files.get_file(f"{self._root}/{name}", str(temporary))
            if sha256_of(temporary) != sha256:
                raise AtlasError(f"{self.where}/{name} is not the file that was added: its checksum is another")
        return path

    def ages(self) -> dict[str, float]:
        now = time.time()
        with self._told():
            return {f"{TILES}/{Path(name).name}": now - self._modified(name) for name in self._names(TILES)}

    def remove(self, name: str) -> None:
        with self._told(), suppress(FileNotFoundError):  # another writer was here
            self._files.rm_file(f"{self._root}/{name}")

    def _manifests(self) -> list[str]:
        return sorted(name for name in self._names(_MANIFESTS) if Path(name).suffix == ".json" and Path(name).stem.isdecimal())

    def _names(self, folder: str) -> list[str]:
        self._files.invalidate_cache()
        try:
            return [str(name) for name in self._files.ls(f"{self._root}/{folder}", detail=False)]
        except FileNotFoundError:
            return []

    def _modified(self, name: str) -> float:
        """Seconds of Unix time."""
        when: Any = self._files.modified(name)
        return when.timestamp() if isinstance(when, datetime) else float(when)

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Whatever a store's client raises is one failure here: these have errors of their own each."""
        try:
            yield
        except (AtlasError, FileExistsError):
            raise
        except Exception as error:
            text = " ".join(str(error).split())[:200] or type(error).__name__
            raise AtlasError(f"{self.where} does not answer, or not as a store: {text}") from error


@contextmanager
def _made(path: Path) -> Iterator[Path]:
    path.parent.mkdir(parents=True, exist_ok=True)
    with replaced_file(path) as temporary:
        yield temporary
