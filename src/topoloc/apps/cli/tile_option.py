"""The option `--tile`, and work on the selected tiles of a map file or an atlas."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import tyro

from topoloc import Atlas, AtlasError, MapError, ObjectStoreError, SharedWorld, SingleMap
from topoloc.apps.cli.output import UsageError, print_line, print_warning, write_json

TileOption = Annotated[str | None, tyro.conf.arg(metavar="ID", help_behavior_hint="(atlases only)")]
_MAX_LISTED = 8


def select_tile(place: SingleMap | Atlas, tile_id: str | None) -> str:
    """Return the id of the named tile, or of the only one. Raises AtlasError: there is no such
    tile; UsageError: there are several tiles, and none is named."""
    ids = place.select_tiles(tile_id)
    if len(ids) != 1:
        raise UsageError(
            f"{place.name} is an atlas: select a tile with --tile ({_format_ids(ids)})"
        )
    return ids[0]


def _format_ids(ids: Sequence[str]) -> str:
    return (
        ", ".join(ids[:_MAX_LISTED]) + (", ..." if len(ids) > _MAX_LISTED else "") or "it has none"
    )


def select_world(atlas: Atlas, tile_id: str | None) -> SharedWorld:
    """Return the world of the named tile alone, or else the shared world with most nodes. A warning
    lists the tiles of other worlds. Raises AtlasError: there is no such tile, or no tile at all."""
    if tile_id is not None:
        return SharedWorld.of_tile(atlas.manifest, atlas.tile(tile_id))
    worlds = SharedWorld.group(atlas.manifest)
    if not worlds:
        raise AtlasError(
            f"the atlas {atlas.store.where} has no tiles; `topoloc atlas add` adds them"
        )
    others = [placed.tile.tile_id for world in worlds[1:] for placed in world.tiles]
    if others:
        print_warning(f"tiles of other worlds are left out ({_format_ids(others)}); use --tile")
    return worlds[0]


def run_for_each_tile(
    place: SingleMap | Atlas,
    tile_id: str | None,
    work: Callable[[str], dict[str, Any]],
    json: str | None,
) -> int:
    """Run `work` for the named tile, or else for each tile, write its results to the file `json`,
    and return the exit status.

    If a tile of an atlas fails, its error is printed, the others continue, and the status is 1.
    Raises MapError: the only map fails, or there is no such tile; ObjectStoreError: the store does
    not respond, so that each other tile would wait for it too.
    """
    facts, ids = dict[str, dict[str, Any]](), place.select_tiles(tile_id)
    for one in ids:
        try:
            facts[one] = work(one)
        except MapError as error:
            if not one or isinstance(error, ObjectStoreError):
                raise
            text = str(error)
            named = text if f"tile {one}" in text else f"tile {one}: {text}"
            print_line(f"error: {named}", sys.stderr)
    write_json(json, place.report(facts))
    return 0 if len(facts) == len(ids) else 1
