"""Declare the bounds of settings beside the fields: `Annotated[float, Above(0)]`.

`check_bounds` checks values set in Python. `parse_settings` checks values read from a TOML file, a
map or a stored model. Numbers must be finite, whatever their bounds. A whole number with bounds
must be at most 2^31 - 1.

Settings that earlier versions had are dropped from files that still contain them.
`removed_settings.json` holds these keys with their old defaults, in nested tables.
"""

from __future__ import annotations

import json
import re
import sys
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from difflib import get_close_matches
from functools import cache
from importlib.resources import files
from inspect import Parameter, signature
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from topoloc.errors import ConfigError, TopolocError

T = TypeVar("T")
_MAX_INT32 = 2**31 - 1


@dataclass(frozen=True)
class Bound:
    """Hold what a number must be, as a text and as a test. Created by the functions below."""

    text: str
    is_satisfied: Callable[[float | int], bool]


def Above(limit: float | int) -> Bound:
    """Require a number greater than `limit`."""
    return Bound(f"above {limit}", lambda number: number > limit)


def AtLeast(least: float | int) -> Bound:
    """Require a number of `least` or greater."""
    return Bound(f"at least {least}", lambda number: number >= least)


def Between(least: float | int, most: float | int) -> Bound:
    """Require a number from `least` to `most`, both included."""
    return Bound(f"from {least} to {most}", lambda number: least <= number <= most)


def check_bounds(config: Any, name: str | None = None) -> None:
    """Check that each value of a configuration dataclass has its declared type and lies within its
    bounds. Nested dataclasses are checked too.

    Args:
        name: name of the configuration in the error. Default: its class.

    Raises:
        ConfigError: a value is invalid. The text begins with its key, such as
            `BuildConfig.nodes.d_thresh`.
    """
    name = type(config).__name__ if name is None else name
    for key, kind in field_annotations(type(config)).items():
        value = getattr(config, key)
        if wrong := find_violation(value, kind):
            raise ConfigError(f"{name}.{key}: {wrong}")
        if is_dataclass(value):
            check_bounds(value, f"{name}.{key}")


def parse_settings(
    of: type[T],
    data: Any,
    key: str,
    default: T | None = None,
    known: Collection[str] | None = None,
    is_strict: bool = True,
) -> T:
    """Create the dataclass `of` from the nested values of a TOML or JSON file. Types and bounds are
    checked.

    Args:
        key: name of `data` in errors.
        default: source of the values that `data` does not contain. Default: the defaults of the
            class.
        known: keys among which a similar one is suggested for an unknown key. Default: the keys of
            `of`.
        is_strict: raise an error for an unknown key instead of ignoring it.

    Raises:
        ConfigError: a key is unknown or missing, or a value is invalid. The text names the key.
    """
    if not isinstance(data, dict):
        raise ConfigError(f"{key}: a table is expected, [{key}]")
    kinds, known = field_annotations(of), known or list(iter_keys(of, key))
    values = {name: getattr(default, name) for name in kinds} if default is not None else {}
    for name, value in data.items():
        full_key = f"{key}.{quote_key(name)}"
        if name in kinds:
            values[name] = parse_value(
                kinds[name], value, full_key, values.get(name), known, is_strict
            )
        elif is_strict:
            raise ConfigError(f"{full_key}: no such setting{suggest_name(full_key, known)}")
    for name, parameter in signature(of).parameters.items():
        if parameter.default is Parameter.empty and name not in values:
            raise ConfigError(f"{key}.{name}: is missing")
    with ConfigError.at(key, ValueError, TopolocError):  # values that do not go together
        return of(**values)


def parse_value(
    kind: Any,
    value: Any,
    key: str,
    default: Any = None,
    known: Collection[str] | None = None,
    is_strict: bool = True,
) -> Any:
    """Convert one value to its annotated type and check it. Arguments and errors are those of
    `parse_settings`."""
    plain, may_be_none = strip_annotation(kind)
    if hasattr(plain, "__dataclass_fields__") and not (value is None and may_be_none):
        return parse_settings(plain, value, key, default, known, is_strict)
    value = _convert_to_declared(value, plain)
    if wrong := find_violation(value, kind):
        raise ConfigError(f"{key}: {wrong}")
    return value


def iter_keys(kind: Any, key: str) -> Iterator[str]:
    """Yield the keys of a dataclass named `key`, and the keys of its nested dataclasses."""
    for name, declared in field_annotations(kind).items():
        yield f"{key}.{name}"
        if is_dataclass(plain := strip_annotation(declared)[0]):
            yield from iter_keys(plain, f"{key}.{name}")


def suggest_name(name: str, names: Collection[str]) -> str:
    """Return the end of an error about an unknown name: the most similar known name, if any."""
    near = get_close_matches(name[:100], names, n=1)
    return f"; did you mean {near[0]}?" if near else ""


def quote_key(name: Any) -> str:
    """Return a key in a form that fits into a line: as it is, or quoted and shortened."""
    is_plain = re.fullmatch(r"[\w-]{1,60}", name)
    return name if is_plain else json.dumps(name if len(name) <= 60 else name[:57] + "...")


@cache
def field_annotations(kind: type) -> dict[str, Any]:
    """Return the annotation of each field of a dataclass, bounds included, in the order of the
    fields."""
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in fields(kind)}


def field_bounds(kind: Any) -> list[Bound]:
    """Return the bounds in an annotation."""
    extras = get_args(kind)[1:] if get_origin(kind) is Annotated else ()
    return [extra for extra in extras if isinstance(extra, Bound)]


def describe_ranges(config: type) -> dict[str, str]:
    """Return the values that each field of a dataclass allows, for a file of settings: its choices
    or its bounds; empty if it has none."""
    return {name: _describe_range(kind) for name, kind in field_annotations(config).items()}


def _describe_range(kind: Any) -> str:
    plain, _ = strip_annotation(kind)
    if get_origin(plain) is Literal:
        return "one of " + ", ".join(map(json.dumps, get_args(plain)))
    return " and ".join(bound.text for bound in field_bounds(kind))


def strip_annotation(kind: Any) -> tuple[Any, bool]:
    """Return the type in an annotation without its bounds and None, and whether None is allowed."""
    if get_origin(kind) is Annotated:
        kind = get_args(kind)[0]
    if get_origin(kind) in (Union, UnionType):
        others = [choice for choice in get_args(kind) if choice is not NoneType]
        return (others[0] if len(others) == 1 else Union[tuple(others)]), NoneType in get_args(kind)  # noqa: UP007
    return kind, False


def with_setting(config: T, key: str, value: Any) -> T:
    """Return the configuration with another value of one setting.

    Args:
        key: path of the setting, such as "nodes.d_thresh".

    Raises:
        ConfigError: the value is invalid.
    """
    before: Any = config
    name, _, rest = key.partition(".")
    if rest:
        value = with_setting(getattr(config, name), rest, value)
    elif wrong := find_violation(value, field_annotations(type(config))[name]):
        raise ConfigError(wrong)
    return replace(before, **{name: value})


def find_violation(value: Any, kind: Any) -> str | None:
    """Return why `value` is invalid for a field declared as `kind`, or None if it is valid. The
    fields of a nested dataclass are not checked."""
    plain, may_be_none = strip_annotation(kind)
    if value is None and may_be_none:
        return None
    if not _is_instance(value, plain):
        return f"{describe_type(plain)} is expected, not {_shorten(value)}"
    for number in _iter_numbers(value):
        if not abs(number) <= sys.float_info.max:  # true for NaN
            return f"must be a finite number, not {_shorten(number)}"
        for bound in field_bounds(kind):
            if not bound.is_satisfied(number):
                return f"must be {bound.text}, not {_shorten(number)}"
        if plain is int and field_bounds(kind) and number > _MAX_INT32:
            return f"must be at most {_MAX_INT32}, not {_shorten(number)}"
    return None


def _convert_to_declared(value: Any, plain: Any) -> Any:
    """Convert types that TOML and JSON lack: lists to tuples, and whole numbers to floats if a
    float is declared."""
    if get_origin(plain) is tuple and isinstance(value, list):
        items = get_args(plain)
        kinds = [items[0]] * len(value) if items[-1] is ... else [*items, *[None] * len(value)]
        return tuple(map(_convert_to_declared, value, kinds))
    return float(value) if plain is float and type(value) is int and abs(value) < 2**53 else value


def describe_type(plain: Any) -> str:
    """Return a readable description of a type."""
    if get_origin(plain) is Literal:
        return "one of " + ", ".join(get_args(plain))
    if get_origin(plain) is tuple:
        items = get_args(plain)
        number = "" if items[-1] is ... else f"{len(items)} "
        return f"a list of {number}values"
    names = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}
    return names.get(plain) or f"a {getattr(plain, '__name__', plain)}"


def _shorten(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _is_instance(value: Any, plain: Any) -> bool:
    if get_origin(plain) is Literal:
        return isinstance(value, str) and value in get_args(plain)
    if get_origin(plain) is tuple:
        if not isinstance(value, tuple):
            return False
        items = get_args(plain)
        items = items[:1] * len(value) if items[-1] is ... else items
        return len(value) == len(items) and all(map(_is_instance, value, items))
    if plain is float:
        return isinstance(value, Real) and not isinstance(value, bool)
    if plain is int:
        return isinstance(value, Integral) and not isinstance(value, bool)
    return isinstance(value, plain)


def _iter_numbers(value: Any) -> Iterator[Any]:
    """Yield the numbers in a value. NumPy numbers are converted to Python's."""
    if isinstance(value, tuple):
        for item in value:
            yield from _iter_numbers(item)
    elif isinstance(value, Real) and not isinstance(value, bool):
        yield int(value) if isinstance(value, Integral) else float(value)


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
