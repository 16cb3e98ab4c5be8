"""Open a map file or an atlas. Both are places of tiles, with the same methods."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from topoloc.atlas.atlas import Atlas
from topoloc.atlas.editing import NewTile, replace_tile
from topoloc.atlas.manifest import StoredFile
from topoloc.atlas.store import MANIFEST, sha256_of
from topoloc.errors import AtlasError, TopolocError
from topoloc.mapping.edit import read_history
from topoloc.mapping.storage.kept_files import kept_path
from topoloc.recordings.atomic import temporary_folder

_MAX_TRIES = 5
T = TypeVar("T")


@dataclass(frozen=True)
class SingleMap:
    """A map file with the methods of an atlas. It is one tile with the id "".

    The file need not exist: the methods that read it raise MapError then.
    """

    where: str

    @property
    def name(self) -> str:
        """Return the name of the file without .topo."""
        return Path(self.where).name.removesuffix(".topo")

    def select_tiles(self, tile_id: str | None = None) -> list[str]:
        """Return [""]. Raises AtlasError: a tile is named."""
        if tile_id is not None:
            raise AtlasError(
                f"{self.where} is a map file and has no tile {tile_id[:80]!r}; omit the tile"
            )
        return [""]

    def title(self, tile_id: str) -> str:
        """Return the path of the file."""
        return self.where

    def history(self, tile_id: str) -> list[dict[str, Any]]:
        """Return the edits of the map, as `read_history` does. Raises MapError."""
        return read_history(self.where)

    def edit(self, tile_id: str, edit: Callable[[Path], T]) -> T:
        """Return the result of `edit`, called with the path of the file. Raises as `edit`."""
        return edit(Path(self.where))

    def report(self, facts: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
        """Return the facts of the map as one JSON object."""
        return {"map": self.where} | facts[""]

    def visit(self, on_map: Callable[[str], T], on_atlas: Callable[[Atlas], T]) -> T:
        """Return the result of `on_map`, called with the path of the file."""
        return on_map(self.where)


def open_place(where: str) -> SingleMap | Atlas:
    """Open the atlas in a folder or an object store. Any other path is a map file, which is not
    opened yet.

    Raises:
        AtlasError: the atlas is damaged.
        ObjectStoreError, MissingExtraError: an object store does not respond, or its extra is not
            installed.
    """
    if "://" in where or os.path.isfile(Path(where) / MANIFEST):
        return Atlas.open(where)
    return SingleMap(where)


def edit_tile(where: str, tile_id: str, edit: Callable[[Path], T]) -> T:
    """Edit the map of a tile. The tile keeps its world and its joins.

    Args:
        where: the atlas.
        tile_id: the tile.
        edit: a function that edits the map file at a path, as `mapping/edit.py` does. It receives a
            copy, with the file before the last edit kept beside it. It is called again if another
            writer replaced the tile in the meantime.

    Returns:
        The result of `edit`.

    Raises:
        AtlasError: there is no such atlas or tile, it cannot be read or written, or other writers
            replaced the tile in each of five tries.
        TopolocError: raised by `edit`. The atlas stays unchanged.
    """
    for _ in range(_MAX_TRIES):
        atlas = Atlas.open(where)
        before = atlas.tile(tile_id)
        with temporary_folder("topoloc-tile-") as folder:
            path = folder / f"{tile_id}.topo"
            _copy_map(atlas, before.map, path)
            for last in before.previous[:1]:
                _copy_map(atlas, last, kept_path(path, before.map.sha256, last.sha256))
            done = _edit_with_tile_name(edit, path, f"{where}, tile {tile_id}")
            if sha256_of(path) == before.map.sha256:
                return done
            new = NewTile(tile_id, path, before.world, before.recipe, before.previous[1:])
            after = replace_tile(where, new, before)
        if after is not None:
            return done
    raise AtlasError(
        f"{where}: tile {tile_id} was replaced by others {_MAX_TRIES} times meanwhile; it stays as"
        " they left it"
    )


def _edit_with_tile_name(edit: Callable[[Path], T], path: Path, name: str) -> T:
    """Call `edit` and return its result. Its errors name the tile instead of the copy."""
    try:
        return edit(path)
    except TopolocError as error:
        error.args = (str(error).replace(str(path), name), *error.args[1:])
        raise


def _copy_map(atlas: Atlas, stored: StoredFile, path: Path) -> None:
    try:
        shutil.copyfile(atlas.store.local_path(stored.name, stored.sha256), path)
    except OSError as error:
        raise AtlasError(
            f"cannot copy {stored.name} of {atlas.store.where}: {error.strerror}"
        ) from None
    if sha256_of(path) != stored.sha256:
        raise AtlasError(
            f"{stored.name} of {atlas.store.where} is not the file that was added: its checksum is"
            " another"
        )
