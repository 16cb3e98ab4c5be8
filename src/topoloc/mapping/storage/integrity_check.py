"""Check a whole map file: the checksum of every row, the digest, and the content of every entry.
Also describe its contents in numbers and words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from topoloc.errors import EmptyMapError, MapError
from topoloc.json_data import decode_json
from topoloc.mapping.coarse_models import open_map_coarse_localizer
from topoloc.mapping.storage.entries import TopoNode
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
    with TopoMetricMap.load(path) as topomap, closing(MapFile(path)) as file:
        found = [*_check_rows(file), *_check_entries(topomap)]
    return list(dict.fromkeys(text.removeprefix(f"map {path} is damaged: ") for text in found))


def describe_map(topomap: TopoMetricMap, path: Path) -> dict[str, Any]:
    """Return the facts of a map for evaluations and `info`: counts, bytes, extent, configuration.

    Raises:
        EmptyMapError: the map has no node.
    """
    if len(topomap.summaries) == 0:
        raise EmptyMapError(f"map {path} has no nodes")
    models = list_coarse_models(path)
    centres = np.array([s.world_from_cam.translation for s in topomap.summaries])
    num_nodes = Counter(summary.session_id for summary in topomap.summaries)
    return {
        "path": str(path),
        "map": topomap.id,
        "version": topomap.version,
        "georeference": None if topomap.georeference is None else topomap.georeference.to_json(),
        "certificate": topomap.describe_certificate(),
        "bytes": path.stat().st_size,
        "num_nodes": len(topomap.summaries),
        "num_points": sum(s.num_points for s in topomap.summaries),
        "num_side_nodes": len(topomap.sides.summaries) if topomap.sides else 0,
        "num_place_images": len(topomap.place_images),
        "length_m": round(topomap.length_m, 3),
        "extent_m": np.ptp(centres, axis=0).round(3).tolist(),
        "recordings": sorted({s.recording for s in topomap.summaries}),
        "sessions": [
            asdict(session)
            | {
                "camera": None if session.camera is None else session.camera.to_json(),
                "start_date": session.start_date,
                "end_date": session.end_date,
                "num_nodes": num_nodes[session.session_id],
            }
            for session in topomap.sessions
        ],
        "edits": [asdict(edit) for edit in topomap.edits],
        "coarse": [model["name"] for model in models],
        "default_coarse": topomap.default_coarse,
        "kinds": topomap.kinds,
        "coarse_models": models,
        "config": topomap.config.to_json(),
    }


def list_coarse_models(path: Path) -> list[dict[str, Any]]:
    """Return the name, bytes, backbone and weights of each coarse localizer of a map file. Raises
    MapError."""
    query = "SELECT name, settings, length(arrays) FROM coarse_models ORDER BY name LIMIT 1000"
    with closing(MapFile(path)) as file, file.read_connection() as database:
        return [_model_facts(*row) for row in database.execute(query)]


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


def _model_facts(name: str, text: str, num_bytes: int) -> dict[str, Any]:
    settings = decode_json(text, dict[str, Any], CorruptDataError, f"coarse localizer {name}")
    return {"name": name, "bytes": num_bytes} | {
        key: settings[key] for key in ("backbone", "weights", "trained") if key in settings
    }
