"""Check a whole map file: the checksum of every row, the digest, and the content of every entry.
Also list its coarse localizers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from topoloc.errors import MapError
from topoloc.json_data import decode_json
from topoloc.mapping.coarse_models import open_map_coarse_localizer
from topoloc.mapping.storage.map_file import MapFile
from topoloc.mapping.storage.map_writing import compute_map_digest
from topoloc.mapping.storage.schema import SORT_COLUMNS, TABLES
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.mapping.validation import CorruptDataError
from topoloc.retrieval.coarse import open_coarse_localizer


def find_map_damage(path: Path) -> list[str]:
    """Return the damages of the file, one line each, without the map's name. Empty if there is
    none.

    Raises:
        MapError: the file cannot be opened.
    """
    with TopoMetricMap.load(path) as topomap:
        file = topomap.file
        assert file is not None, "a map that was just opened"
        found = [*_check_rows(file), *_check_entries(topomap)]
    return list(dict.fromkeys(text.removeprefix(f"map {path} is damaged: ") for text in found))


def list_coarse_models(path: Path) -> list[dict[str, Any]]:
    """Return the name, bytes, backbone and weights of each coarse localizer of a map file. Raises
    MapError."""
    file = MapFile(path)
    try:
        with file.read_connection() as database:
            query = (
                "SELECT name, settings, length(arrays) FROM coarse_models ORDER BY name LIMIT 1000"
            )
            return [
                _model_facts(name, settings, num_bytes)
                for name, settings, num_bytes in database.execute(query)
            ]
    finally:
        file.close()


def _check_rows(file: MapFile) -> Iterator[str]:
    checksums: dict[str, list[bytes]] = {}
    for table in TABLES:
        keys = tuple(SORT_COLUMNS[table].split(", "))
        rows, damage = _try_read(lambda table=table, keys=keys: file.rows(table, keys))
        yield from damage
        for row in rows or ():
            yield from _try_read(lambda table=table, row=row: file.row(table, **row))[1]
        if file.version > 1:
            kept, _ = _try_read(lambda table=table: file.checksums(table))
            checksums[table] = kept or []
    if file.version > 1 and compute_map_digest(checksums) != file.digest:
        yield "its digest is not that of its rows"


def _check_entries(topomap: TopoMetricMap) -> Iterator[str]:
    for layer in topomap.layers.values():
        yield from _check_each(layer.nodes, _read_session_statistics)
    yield from _check_each(topomap.place_images, lambda image: topomap.row_of(image.node_id))
    if topomap.repetitions is not None:
        moves = topomap.repetitions.moves
        for node_id in moves:
            yield from _try_read(lambda node_id=node_id: (moves[node_id], topomap.row_of(node_id)))[
                1
            ]
    known = {summary.node_id for summary in topomap.summaries}
    for edge in topomap.edges:
        if not {edge.source_id, edge.target_id} <= known:
            yield (
                f"an edge from node {edge.source_id} to node {edge.target_id}, one of which is"
                " missing"
            )
    for kind, layer in topomap.layers.items():
        for name in layer.coarse_models:
            yield from _try_read(partial(open_map_coarse_localizer, topomap, name, kind))[1]
    if topomap.sides is not None:
        yield from _check_each(topomap.sides.nodes, lambda node: None)
        sides = topomap.sides.coarse_models
        for name in sides:
            yield from _try_read(lambda name=name: open_coarse_localizer(sides[name]))[1]


def _read_session_statistics(node: Any) -> None:
    list(node.session_statistics)


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


def _model_facts(name: str, text: str, num_bytes: int) -> dict[str, Any]:
    settings = decode_json(text, dict[str, Any], CorruptDataError, f"coarse localizer {name}")
    shown = ("backbone", "weights", "trained")
    return {"name": name, "bytes": num_bytes} | {
        key: settings[key] for key in shown if key in settings
    }
