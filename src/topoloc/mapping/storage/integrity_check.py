"""Check a whole map file: the checksum of every row, the digest, and the content of every
entry."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

from topoloc.errors import MapError
from topoloc.mapping.coarse_models import open_map_coarse_localizer
from topoloc.mapping.storage.entries import TopoNode
from topoloc.mapping.storage.map_file import MapFile
from topoloc.mapping.storage.map_writing import compute_map_digest
from topoloc.mapping.storage.schema import SORT_COLUMNS, TABLES
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.retrieval.coarse import open_coarse_localizer


def find_map_damage(path: Path) -> list[str]:
    """Return the damages of the file, one line each, without the map's name. Empty if there is
    none.

    Raises:
        MapError: the file cannot be opened.
    """
    with TopoMetricMap.load(path) as topomap, closing(MapFile(path)) as file:
        found = [*_check_rows(file), *_check_entries(topomap)]
    return list(dict.fromkeys(text.removeprefix(f"map {path} is damaged: ") for text in found))


def _check_rows(file: MapFile) -> Iterator[str]:
    checksums: dict[str, list[bytes]] = {}
    for table in TABLES:
        rows, damage = _try_read(partial(file.rows, table, tuple(SORT_COLUMNS[table].split(", "))))
        yield from damage
        yield from _check_each(rows or (), lambda row, table=table: file.find(table, **row))
        if file.version > 1:
            checksums[table] = _try_read(partial(file.checksums, table))[0] or []
    if file.version > 1 and compute_map_digest(checksums) != file.digest:
        yield "its digest is not that of its rows"


def _check_entries(topomap: TopoMetricMap) -> Iterator[str]:
    for layer in topomap.layers.values():
        yield from _check_each(layer.nodes, lambda node: list(node.session_statistics))
    yield from _check_each(topomap.nodes, TopoNode.read_image)
    yield from _check_each(topomap.place_images, lambda image: topomap.row_of(image.node_id))
    if topomap.repetitions is not None:
        moves = topomap.repetitions.moves
        yield from _check_each(list(moves), lambda one: (moves[one], topomap.row_of(one)))
    known = {summary.node_id for summary in topomap.summaries}
    for edge in topomap.edges:
        ends = edge.source_id, edge.target_id
        if not known.issuperset(ends):
            yield "an edge from node {} to node {}, one of which is missing".format(*ends)
    for kind, layer in topomap.layers.items():
        opened = partial(open_map_coarse_localizer, topomap, kind=kind)
        yield from _check_each(list(layer.coarse_models), opened)
    if topomap.sides is not None:
        yield from _check_each(topomap.sides.nodes, lambda node: None)
        sides = topomap.sides.coarse_models
        yield from _check_each(list(sides), lambda name: open_coarse_localizer(sides[name]))


def _check_each(entries: Any, look: Callable[[Any], Any]) -> Iterator[str]:
    length, damage = _try_read(lambda: len(entries))
    yield from damage
    for row in range(length or 0):
        yield from _try_read(lambda row=row: look(entries[row]))[1]


def _try_read(read: Callable[[], Any]) -> tuple[Any, list[str]]:
    try:
        return read(), []
    except MapError as error:
        return None, [str(error)]
    except KeyError as error:  # raised by `row_of`
        return None, [f"node {error} is missing"]
