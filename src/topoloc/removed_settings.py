"""Drop the settings that earlier versions had from files that still contain them.

`removed_settings.json` holds these keys with their old defaults, in nested tables.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from importlib.resources import files
from typing import Any


def drop_removed_settings(
    data: Mapping[str, Any], table: str = "", source: str = ""
) -> dict[str, Any]:
    """Return nested settings without removed keys and without tables that only held such keys.

    One warning names the removed keys whose values differ from the old defaults.

    Args:
        table: dotted name of `data`, such as `build`. Default: `data` holds all tables.
        source: the beginning of the warning, such as the name of the file.
    """
    removed = json.loads((files("topoloc") / "removed_settings.json").read_text("utf-8"))
    for name in table.split(".") if table else ():
        removed = removed[name]
    changed = list[str]()
    left = _drop(data, removed, table, changed)
    if changed:
        named = ", ".join(changed)
        warnings.warn(f"{source}no longer settings, without effect: {named}", stacklevel=3)
    return left


def _drop(
    data: Mapping[str, Any], removed: dict[str, Any], table: str, changed: list[str]
) -> dict[str, Any]:
    left = dict[str, Any]()
    for name, value in data.items():
        key, old = f"{table}.{name}".lstrip("."), removed.get(name)
        if isinstance(old, dict):
            rest = _drop(value, old, key, changed) if isinstance(value, dict) else value
            left |= {} if rest == {} else {name: rest}
        elif name not in removed:
            left[name] = value
        elif value != old:
            changed.append(key)
    return left
