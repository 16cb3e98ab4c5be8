"""An atlas that others write to while it is asked for long: opened anew when its manifest was
written again.

In a folder whoever asks looks at the manifest file. An object store may take a minute to say that
nothing is new, so there somebody looks now and then (`look`), beside those who ask; they go on with
what was opened before, also while the store is silent.
"""

from __future__ import annotations

import threading
from collections.abc import Hashable

from topoloc.atlas.atlas import Atlas, store_at
from topoloc.errors import AtlasError


class WatchedAtlas:
    """The atlas there, as its manifest is now.

    Raises:
        AtlasError: there is none, or it is damaged; StoreError where its store does not answer.
        MissingExtraError: as `store_at`.
    """

    def __init__(self, where: str) -> None:
        self.where, self.is_remote = where, "://" in where
        self._store, self._lock = store_at(where), threading.Lock()
        self._version: Hashable | None = None
        self._atlas: Atlas | None = None
        self.look()

    def now(self) -> Atlas:
        """Of a folder by its manifest as it is; of an object store by the one that was seen last,
        at once. Raises AtlasError."""
        if not self.is_remote:
            with self._lock:
                self.look()
        assert self._atlas is not None
        return self._atlas

    def look(self) -> bool:
        """Is another manifest there than the one before? Its atlas is the one from now on, where it
        can be opened. One caller at a time.

        Raises:
            AtlasError: it cannot, or is gone; StoreError where the store does not answer.
        """
        version = self._store.version()
        if version is None:
            raise AtlasError(f"{self.where} is no atlas, or not any more: it has no manifest")
        if version == self._version:
            return False
        atlas = Atlas.open(self.where)
        if self.is_remote:
            _ = atlas.index  # its files are fetched now, and not while somebody waits
        self._version, self._atlas = version, atlas
        return True
