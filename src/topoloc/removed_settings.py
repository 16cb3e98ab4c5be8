"""Drop the settings that earlier versions had from files that still contain them.

`removed_settings.json` holds these keys with their old defaults, in nested tables.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Mapping
from importlib.resources import files
from typing import Any

from topoloc.bounds import parse_settings, quote_key
from topoloc.errors import ConfigError


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


def parse_tables(
    data: Mapping[str, Any], find_class: Callable[[str], type], source: str
) -> list[Any]:
    """Create the configuration of each table of a settings file, without removed settings.

    Args:
        find_class: returns the dataclass of a table. Raises ConfigError if there is none.
        source: the beginning of warnings, such as the name of the file.

    Raises:
        ConfigError: a table or a key is unknown, or a value is invalid. The text names it.
    """
    configs = []
    for name, table in drop_removed_settings(data, source=source).items():
        with ConfigError.at(quote_key(name)):
            kind = find_class(name)
        configs.append(parse_settings(kind, table, name, default=kind()))
    return configs


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
