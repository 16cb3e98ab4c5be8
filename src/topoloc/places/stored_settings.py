"""Settings read back from JSON, typed as their dataclass says: what does not fit is named, by its key.

Maps and coarse localizers keep the settings they were made with; a file from elsewhere may say anything there.
"""

from __future__ import annotations

import json
import math
from dataclasses import MISSING, fields, is_dataclass
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from topoloc.bounds import check_bounds
from topoloc.errors import ConfigError

T = TypeVar("T")


class SettingsError(Exception):
    """A key that is not known or is missing, or a value of another type; the text names the key."""


def json_of(text: str) -> Any:
    """The value of a JSON text. Raises SettingsError, also where it is nested beyond all reason."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise SettingsError(f"no JSON that can be read ({' '.join(str(error).split())[:100]})") from error


def settings_from(of: type[T], data: Any, path: str = "") -> T:
    """The dataclass `of` from the nested values of its `asdict`; keys that are missing take their defaults.

    Args:
        path: what the key of `data` itself is called in errors.

    Raises:
        SettingsError: see there.
    """
    if not isinstance(data, dict):
        raise SettingsError(f"{path or 'settings'}: an object of named values is expected")
    hints, known = get_type_hints(of), {item.name: item for item in fields(of)}  # type: ignore[arg-type]
    unknown = sorted(str(key) for key in data if key not in known)
    if unknown:
        raise SettingsError(f"unknown key {_joined(path, unknown[0][:60])!r}")
    missing = [name for name, item in known.items() if name not in data and item.default is MISSING and item.default_factory is MISSING]
    if missing:
        raise SettingsError(f"key {_joined(path, missing[0])!r} is missing")
    values = {name: value_from(hints[name], value, _joined(path, name)) for name, value in data.items()}
    try:
        return of(**values)
    except ValueError as error:  # bounds that the dataclass itself checks
        raise SettingsError(f"{path or 'settings'}: {error}") from error


def bounded_settings_from(of: type[T], data: Any, path: str = "") -> T:
    """As `settings_from`, of settings that have bounds."""
    config = settings_from(of, data, path)
    try:
        check_bounds(config, path or None)
    except ConfigError as error:
        raise SettingsError(str(error)) from error
    return config


def value_from(of: Any, value: Any, path: str) -> Any:
    """One value as its annotation says. Raises SettingsError."""
    origin = get_origin(of)
    if origin in (Union, UnionType):
        return _one_of(get_args(of), value, path)
    if origin is Literal:
        if value not in get_args(of) or isinstance(value, bool):
            raise SettingsError(f"{path}: {str(value)[:40]!r} is not known (known: {', '.join(map(str, get_args(of)))})")
        return value
    if origin is tuple:
        return _tuple_from(get_args(of), value, path)
    if is_dataclass(of):
        return settings_from(of, value, path)  # type: ignore[arg-type]
    if of is float and isinstance(value, int | float) and not isinstance(value, bool):
        number = float(value) if abs(value) < 1e300 else math.nan
        if not math.isfinite(number):
            raise SettingsError(f"{path}: a finite number is expected")
        return number if isinstance(value, float) else value
    if of in (int, bool, str, dict, NoneType) and type(value) is of:
        return value
    raise SettingsError(f"{path}: {getattr(of, '__name__', of)} is expected, not {type(value).__name__}")


def _one_of(options: tuple[Any, ...], value: Any, path: str) -> Any:
    if value is None and NoneType in options:
        return None
    of = [option for option in options if option is not NoneType]
    for option in of[:-1]:
        try:
            return value_from(option, value, path)
        except SettingsError:
            continue
    return value_from(of[-1], value, path)


def _tuple_from(of: tuple[Any, ...], value: Any, path: str) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise SettingsError(f"{path}: a list is expected, not {type(value).__name__}")
    each = [of[0]] * len(value) if len(of) == 2 and of[1] is Ellipsis else list(of)
    if len(each) != len(value):
        raise SettingsError(f"{path}: {len(each)} values are expected, not {len(value)}")
    return tuple(value_from(option, part, f"{path}[{k}]") for k, (option, part) in enumerate(zip(each, value, strict=True)))


def _joined(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name
