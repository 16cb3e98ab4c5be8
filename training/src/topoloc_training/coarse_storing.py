"""Keeping a taught coarse localizer in a map file: apart from the teaching, for no result of it
follows from how a map is edited."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from topoloc.mapping.edit import edit_map
from topoloc.mapping.storage.entries import Edit, today
from topoloc.mapping.storage.schema import SCHEMA_VERSION
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.retrieval.coarse import CoarseModel


def store_coarse(path: Path, target: Path, model: CoarseModel, make_default: bool) -> None:
    """Write the map of `path` with this coarse localizer to `target`, atomically. Both paths may be
    equal.

    Args:
        make_default: make it the default coarse localizer of the map.

    Raises:
        MapError: `path` is no map, or `target` cannot be written.
    """
    name = f"train {model.name}"
    if target.exists() and path.samefile(target):
        with edit_map(path) as edit:
            edit.commit(_with_model(edit.topomap, model, make_default), name)
        return
    with TopoMetricMap.load(path) as topomap:
        edits = [*topomap.edits, Edit(topomap.free_ids.edit, name, today(), SCHEMA_VERSION)]
        replace(_with_model(topomap, model, make_default), edits=edits).save(target)


def _with_model(topomap: TopoMetricMap, model: CoarseModel, make_default: bool) -> TopoMetricMap:
    models = {**topomap.first_layer.coarse_models, model.name: model}
    return replace(
        topomap.with_first_layer(coarse_models=models),
        default_coarse=model.name if make_default else topomap.default_coarse,
    )
