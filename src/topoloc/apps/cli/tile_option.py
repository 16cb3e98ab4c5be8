"""`--tile`, of commands that are about one map: of an atlas, the tile that is meant."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from topoloc import Atlas, AtlasError, MapError, ObjectStoreError, SharedWorld, is_atlas
from topoloc.apps.cli.output import UsageError

TileOption = Annotated[str | None, tyro.conf.arg(metavar="ID", help_behavior_hint="(atlases only)")]
_MAX_LISTED = 8
T = TypeVar("T")


def edit_map_or_tile(where: str, tile_id: str | None, edit: Callable[[Path], T]) -> T:
    """What the edit of a map file says, or of the map of an atlas's tile, which is replaced by the
    edited one.

    Raises:
        UsageError: an atlas without a tile, or a tile of what is no atlas.
        TopolocError: as of `edit`, and of `edit_tile`.
    """
    check_tile_option(where, tile_id)
    if not is_atlas(where):
        return edit(Path(where))
    if tile_id is None:
        raise UsageError(
            f"{where} is an atlas: --tile says which of its maps is meant"
            f" ({_format_ids(list(Atlas.open(where).manifest.by_id))})"
        )
    from topoloc import edit_tile

    return edit_tile(where, tile_id, edit)[1]


def check_tile_option(where: str, tile_id: str | None) -> None:
    """Raises UsageError: a tile of what is no atlas."""
    if tile_id is not None and not is_atlas(where):
        raise UsageError(f"--tile is of an atlas, and {where} is none")


def _format_ids(ids: Sequence[str]) -> str:
    return (
        ", ".join(ids[:_MAX_LISTED]) + (", ..." if len(ids) > _MAX_LISTED else "") or "it has none"
    )


def select_world(atlas: Atlas, tile_id: str | None) -> SharedWorld:
    """The tile alone; without one the tiles that share a world, those with most nodes, and a line
    where there are others.

    Raises:
        AtlasError: there is no such tile, or none at all.
    """
    if tile_id is not None:
        return SharedWorld.of_tile(atlas.manifest, atlas.tile(tile_id))
    worlds = SharedWorld.group(atlas.manifest)
    if not worlds:
        raise AtlasError(
            f"the atlas {atlas.store.where} has no tiles; `topoloc atlas add` adds them"
        )
    others = [placed.tile.tile_id for world in worlds[1:] for placed in world.tiles]
    if others:
        what = (
            "1 tile of another world is"
            if len(others) == 1
            else f"{len(others)} tiles of other worlds are"
        )
        print_warning(f"{what} left out ({_format_ids(others)}); --tile names one")
    return worlds[0]


def atlas_name(where: str) -> str:
    """The last part of its address."""
    return where.rstrip("/").rpartition("/")[2] or "atlas"


def print_warning(text: str) -> None:
    print(f"warning: {text}", file=sys.stderr)


def run_for_each_tile(
    atlas: Atlas, tile_ids: Sequence[str], work: Callable[[str], dict[str, Any]]
) -> tuple[list[dict[str, Any]], bool]:
    """What `work` says of each tile, beside its id, and whether all went well: one that fails is
    told of and leaves the others.

    Raises:
        ObjectStoreError: the store does not answer; the other tiles would be waited for as long,
            one after the other.
    """
    done = list[dict[str, Any]]()
    for tile_id in tile_ids:
        try:
            done.append({"tile_id": tile_id} | work(tile_id))
        except ObjectStoreError:
            raise
        except MapError as error:
            said = str(error)
            print(
                f"error: {said if f'tile {tile_id}' in said else f'tile {tile_id}: {said}'}",
                file=sys.stderr,
            )
    return done, len(done) == len(tile_ids)
