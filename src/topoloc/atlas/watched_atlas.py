"""Reopen an atlas when its manifest changes, for long-running readers.

In a folder each access checks the manifest file. An object store may take a minute to respond.
There `look` is called now and then in the background, and readers continue with the last version,
even while the store does not respond.
"""

from __future__ import annotations

import threading
from collections.abc import Hashable

from topoloc.atlas.atlas import Atlas, store_at
from topoloc.errors import AtlasError


class WatchedAtlas:
    """Hold the current version of an atlas.

    Raises:
        AtlasError: there is no atlas, or it is damaged.
        ObjectStoreError: its store does not respond.
        MissingExtraError: the extra for object stores is not installed.
    """

    def __init__(self, where: str) -> None:
        self.where, self.is_remote = where, "://" in where
        self._store, self._lock = store_at(where), threading.Lock()
        self._version: Hashable | None = None
        self._atlas: Atlas | None = None
        self.look()

    def now(self) -> Atlas:
        """Return the current atlas of a folder, or the last seen version of an object store.

        Raises:
            AtlasError: the atlas cannot be read.
        """
        if not self.is_remote:
            with self._lock:
                self.look()
        assert self._atlas is not None
        return self._atlas

    def look(self) -> bool:
        """Open the atlas again if its manifest changed, and return whether it did.

        Only one thread may call it at a time.

        Raises:
            AtlasError: the atlas is gone or damaged.
            ObjectStoreError: the store does not respond.
        """
        version = self._store.version()
        if version is None:
            raise AtlasError(f"{self.where} is no atlas, or not any more: it has no manifest")
        if version == self._version:
            return False
        atlas = Atlas.open(self.where)
        if self.is_remote:
            _ = atlas.index  # fetches the index files now, not during a query
        self._version, self._atlas = version, atlas
        return True
