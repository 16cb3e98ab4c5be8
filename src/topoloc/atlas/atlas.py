"""An atlas read: its manifest as it was at that moment, the files that it names, and the index over
all its places."""

from __future__ import annotations

import importlib
import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from topoloc.atlas.global_descriptors import GlobalDescriptors, load_global_descriptors
from topoloc.atlas.index import AtlasIndex
from topoloc.atlas.index_files import OpenedIndex, index_folder, open_index
from topoloc.atlas.manifest import Manifest, Tile
from topoloc.atlas.store import MANIFEST, FolderStore, Store, sha256_of
from topoloc.errors import AtlasError

_OBJECT_STORES = "topoloc.apps.stores.object_store"
"""The module of `ObjectStore`. A string: fsspec is an extra, and stores are an app."""


def store_at(where: str) -> Store:
    """The folder, or the object store, that an atlas lies in. Raises AtlasError,
    MissingExtraError."""
    if "://" in where:
        return importlib.import_module(_OBJECT_STORES).ObjectStore(where)
    return FolderStore(Path(where))


def is_atlas(where: str) -> bool:
    """Is this an atlas, and no map?"""
    return "://" in where or os.path.isfile(Path(where) / MANIFEST)


def absolute_address(where: str) -> str:
    """Of an atlas, as it is found from any folder."""
    return where if "://" in where else os.path.abspath(where)


@dataclass(frozen=True, eq=False)
class Atlas:
    """An atlas as its manifest said when it was read; later writes are not seen. Tiles keep their
    files while anybody may ask them."""

    store: Store
    manifest: Manifest

    @staticmethod
    def open(where: str) -> Atlas:
        """Read the manifest of the atlas there. Raises AtlasError: there is none, or it is
        damaged."""
        store = store_at(where)
        data = store.manifest()
        if data is None:
            raise AtlasError(
                f"{where} is no atlas: it has no {MANIFEST}; `topoloc atlas create` makes one"
            )
        return Atlas(store, Manifest.from_bytes(data, f"{store.where}/{MANIFEST}"))

    def tile(self, tile_id: str) -> Tile:
        """Raises AtlasError where there is no such tile."""
        tile = self.manifest.by_id.get(tile_id)
        if tile is None:
            known = ", ".join(list(self.manifest.by_id)[:8]) or "none"
            raise AtlasError(
                f"the atlas {self.store.where} has no tile {tile_id[:80]!r} (it has: {known})"
            )
        return tile

    def map_path(self, tile: Tile) -> Path:
        """The tile's map file. Raises AtlasError where it is missing."""
        return self.store.local_path(tile.map.name, tile.map.sha256)

    @cached_property
    def _opened(self) -> OpenedIndex:
        return open_index(self.manifest.tiles, self.places_of, index_folder(self.store.where))

    def places_of(self, tile: Tile) -> GlobalDescriptors:
        """The place vectors of a tile's nodes. Raises AtlasError."""
        return load_global_descriptors(
            self.store.local_path(tile.places.name, tile.places.sha256), tile.vocabularies
        )

    @property
    def problems(self) -> dict[str, str]:
        """Why tiles cannot be ranked, by their ids; they are asked last."""
        return self._opened.problems

    @property
    def notes(self) -> list[str]:
        """What was wrong with the files of the index; it answers all the same."""
        return self._opened.notes

    @property
    def index(self) -> AtlasIndex:
        """Of all tiles whose place vectors can be had."""
        return self._opened.index


def tile_problem(atlas: Atlas, tile: Tile) -> str | None:
    """What is wrong with the bytes of a tile's files; None where they are those that the manifest
    names."""
    for stored in tile.files:
        try:
            path = atlas.store.local_path(stored.name, stored.sha256)
            if path.stat().st_size != stored.num_bytes or sha256_of(path) != stored.sha256:
                return f"{stored.name} is not the file that was added: its checksum is another"
        except AtlasError as error:
            return str(error)
    return None
