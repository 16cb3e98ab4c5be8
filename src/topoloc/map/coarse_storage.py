"""The coarse localizers in a map file: listed without reading them, added or replaced."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from topoloc.map.file import MapFile
from topoloc.map.schema import SCHEMA_VERSION
from topoloc.map.sessions import Edit, today
from topoloc.map.topomap import TopoMetricMap
from topoloc.map.validation import Damage, json_of
from topoloc.places.coarse import CoarseModel


def store_coarse(path: Path, target: Path, model: CoarseModel, make_default: bool) -> None:
    """Write to `target`, which may be `path`, the map of `path` with this coarse localizer in it: at once or not at all.

    Args:
        make_default: it answers from now on where the user names none.

    Raises:
        MapError: `path` is no map, or `target` cannot be written.
    """
    with TopoMetricMap.load(path) as topomap:
        models = {name: topomap.coarse_models[name] for name in topomap.coarse_models} | {model.name: model}
        number = max([topomap.next_ids.edit, *(edit.edit_id + 1 for edit in topomap.edits)])
        edits = [*topomap.edits, Edit(number, f"train {model.name}", today(), SCHEMA_VERSION)]
        default = model.name if make_default else topomap.default_coarse
        replace(topomap, coarse_models=models, edits=edits, default_coarse=default).save(target)


def list_coarse(path: Path) -> list[dict[str, Any]]:
    """Name, bytes, backbone and weights of each coarse localizer of a map file. Raises MapError."""
    file = MapFile(path)
    try:
        with file.reading() as database:
            query = "SELECT name, settings, length(arrays) FROM coarse_models ORDER BY name LIMIT 1000"
            return [_facts(name, json_of(settings), num_bytes) for name, settings, num_bytes in database.execute(query)]
    finally:
        file.close()


def _facts(name: str, settings: Any, num_bytes: int) -> dict[str, Any]:
    if not isinstance(settings, dict):
        raise Damage(f"the settings of coarse localizer {name} are none")
    facts = {"name": name, "bytes": num_bytes}
    return facts | {key: settings[key] for key in ("backbone", "weights", "trained") if key in settings}
