"""The coarse localizers in a map file: listed without reading them, added or replaced without touching the rest."""

from __future__ import annotations

import json
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

from topoloc.errors import MapError
from topoloc.map.storage import check_header, insert_model, replaced_file
from topoloc.places.coarse import CoarseModel


def store_coarse(path: Path, target: Path, model: CoarseModel, make_default: bool) -> None:
    """Write to `target`, which may be `path`, the map of `path` with this coarse localizer in it: at once or not at all.

    Args:
        make_default: it answers from now on where the user names none.

    Raises:
        MapError: `path` is no map, or `target` cannot be written.
    """
    check_header(path)
    if target.is_dir():
        raise MapError(f"cannot write map {target}: it is a folder")
    with replaced_file(target) as temporary:
        shutil.copyfile(path, temporary)
        with closing(sqlite3.connect(temporary)) as database:
            insert_model(database, model)
            if make_default:
                database.execute("INSERT OR REPLACE INTO map VALUES ('default_coarse', ?)", (json.dumps(model.name),))
            database.commit()
            database.execute("VACUUM")  # else the bytes of what was replaced stay in the file


def list_coarse(path: Path) -> list[dict[str, Any]]:
    """Name, bytes, backbone and weights of each coarse localizer of a map file. Raises MapError."""
    check_header(path)
    query = "SELECT name, settings, length(arrays) FROM coarse_models ORDER BY name"
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)) as database:
            return [_facts(name, json.loads(settings), num_bytes) for name, settings, num_bytes in database.execute(query)]
    except (sqlite3.Error, ValueError, AttributeError) as error:
        raise MapError(f"map {path} is damaged: {' '.join(str(error).split())}") from error


def _facts(name: str, settings: dict[str, Any], num_bytes: int) -> dict[str, Any]:
    facts = {"name": name, "bytes": num_bytes}
    return facts | {key: settings[key] for key in ("backbone", "weights", "trained") if key in settings}
