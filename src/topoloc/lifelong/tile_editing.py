"""Edit the map of an atlas tile as a map file, and store the result if no other writer was
faster."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from topoloc.atlas.atlas import Atlas
from topoloc.atlas.editing import NewTile, replace_tile
from topoloc.atlas.manifest import StoredFile, Tile
from topoloc.atlas.store import sha256_of
from topoloc.errors import AtlasError, TopolocError
from topoloc.mapping.kept_files import kept_path
from topoloc.recordings.atomic import temporary_folder

_MAX_TRIES = 5
T = TypeVar("T")


def edit_tile(where: str, tile_id: str, edit: Callable[[Path], T]) -> tuple[Tile, T]:
    """Edit the map of a tile. The tile keeps its world and its joins.

    Args:
        where: the atlas.
        tile_id: the tile.
        edit: a function that edits the map file at a path, as `mapping/edit.py` does. It receives a
            copy, with the file before the last edit kept beside it. It is called again if another
            writer replaced the tile in the meantime.

    Returns:
        The tile after the edit, and the return value of `edit`.

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
                return before, done
            new = NewTile(tile_id, path, before.world, before.recipe, before.previous[1:])
            after = replace_tile(where, new, before)
        if after is not None:
            return after.by_id[tile_id], done
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
