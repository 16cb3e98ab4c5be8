"""Settings and their bounds, which are declared beside the field: `Annotated[float, Above(0)]`.

`check_bounds` holds what was made in Python, `settings_from` what was read from a TOML file, a map
or a stored model. Whatever its bounds, no number may be NaN or infinite, and no whole number that
has bounds so large that it does not fit into 32 bits.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Collection, Iterator
from dataclasses import MISSING, dataclass, fields, is_dataclass
from difflib import get_close_matches
from functools import cache
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from topoloc.errors import ConfigError, TopolocError

T = TypeVar("T")
_LARGEST_WHOLE = 2**31 - 1


@dataclass(frozen=True)
class Above:
    """Greater than `limit`."""

    limit: float | int

    def holds(self, number: float | int) -> bool:
        return number > self.limit

    def __str__(self) -> str:
        return f"above {self.limit}"


@dataclass(frozen=True)
class AtLeast:
    """`limit` or greater."""

    limit: float | int

    def holds(self, number: float | int) -> bool:
        return number >= self.limit

    def __str__(self) -> str:
        return f"at least {self.limit}"


@dataclass(frozen=True)
class Between:
    """From `least` to `most`, both included."""

    least: float | int
    most: float | int

    def holds(self, number: float | int) -> bool:
        return self.least <= number <= self.most

    def __str__(self) -> str:
        return f"from {self.least} to {self.most}"


Bound = Above | AtLeast | Between


def check_bounds(config: Any, name: str | None = None) -> None:
    """Hold that every value of a configuration (a dataclass, and those in it) is of its type and
    within its bounds.

    Args:
        name: what the configuration is called in the error; by default its class.

    Raises:
        ConfigError: one is not; the text begins with its key, `BuildConfig.nodes.d_thresh`.
    """
    name = type(config).__name__ if name is None else name
    for key, kind in annotations_of(type(config)).items():
        value = getattr(config, key)
        if wrong := complaint(value, kind):
            raise ConfigError(f"{name}.{key}: {wrong}")
        if is_dataclass(value):
            check_bounds(value, f"{name}.{key}")


def settings_from(
    of: type[T],
    data: Any,
    key: str,
    default: T | None = None,
    known: Collection[str] | None = None,
    is_strict: bool = True,
) -> T:
    """The dataclass `of` from the nested values of a TOML or JSON file, each of its type and within
    its bounds.

    Args:
        key: what `data` is called in errors.
        default: what keeps its value where `data` has none; by default that of the class.
        known: the keys that are proposed instead of one that there is not; by default those of
            `of`.
        is_strict: such a key is an error; else it is left out.

    Raises:
        ConfigError: a key that there is not or that is missing, or a value that cannot be; names
            the key.
    """
    if not isinstance(data, dict):
        raise ConfigError(f"{key}: a table is expected, [{key}]")
    kinds, known = annotations_of(of), known or list(keys_of(of, key))
    values = {name: getattr(default, name) for name in kinds} if default is not None else {}
    for name, value in data.items():
        its_key = f"{key}.{quoted(name)}"
        if name in kinds:
            values[name] = value_from(
                kinds[name], value, its_key, values.get(name), known, is_strict
            )
        elif is_strict:
            raise ConfigError(f"{its_key}: no such setting{did_you_mean(its_key, known)}")
    required = (
        field.name
        for field in fields(of)  # pyright: ignore[reportArgumentType]
        if field.default is MISSING and field.default_factory is MISSING
    )
    if missing := [name for name in required if name not in values]:
        raise ConfigError(f"{key}.{missing[0]}: is missing")
    try:
        return of(**values)
    except (ValueError, TopolocError) as error:  # values that do not go together
        raise ConfigError(f"{key}: {error}") from None


def value_from(
    kind: Any,
    value: Any,
    key: str,
    default: Any = None,
    known: Collection[str] | None = None,
    is_strict: bool = True,
) -> Any:
    """One value as its annotation says; arguments and errors as of `settings_from`."""
    plain, may_be_none = bare(kind)
    if is_dataclass(plain) and not (value is None and may_be_none):
        return settings_from(plain, value, key, default, known, is_strict)  # pyright: ignore[reportArgumentType]
    value = _as_declared(value, plain)
    if wrong := complaint(value, kind):
        raise ConfigError(f"{key}: {wrong}")
    return value


def keys_of(kind: Any, key: str) -> Iterator[str]:
    """The keys of a dataclass that is called `key`, and of those in it."""
    for name, declared in annotations_of(kind).items():
        yield f"{key}.{name}"
        if is_dataclass(plain := bare(declared)[0]):
            yield from keys_of(plain, f"{key}.{name}")


def did_you_mean(name: str, names: Collection[str]) -> str:
    """The end of an error about a name that there is not."""
    near = get_close_matches(name[:100], names, n=1)
    return f"; did you mean {near[0]}?" if near else ""


def quoted(name: Any) -> str:
    """A key as it can stand in a line."""
    return (
        name
        if re.fullmatch(r"[\w-]{1,60}", name)
        else json.dumps(name if len(name) <= 60 else name[:57] + "...")
    )


@cache
def annotations_of(kind: type) -> dict[str, Any]:
    """The fields of a dataclass, in their order, with what they are declared as, bounds and all."""
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in fields(kind)}


def bounds_of(kind: Any) -> list[Bound]:
    """What an annotation says beside the type."""
    return (
        [extra for extra in get_args(kind)[1:] if isinstance(extra, Bound)]
        if get_origin(kind) is Annotated
        else []
    )


def bare(kind: Any) -> tuple[Any, bool]:
    """The type that an annotation names, without bounds and None, and whether None is allowed."""
    if get_origin(kind) is Annotated:
        kind = get_args(kind)[0]
    if get_origin(kind) in (Union, UnionType):
        others = [choice for choice in get_args(kind) if choice is not NoneType]
        return (others[0] if len(others) == 1 else Union[tuple(others)]), NoneType in get_args(kind)  # noqa: UP007
    return kind, False


def complaint(value: Any, kind: Any) -> str | None:
    """Why `value` cannot be that of a field declared as `kind`; None where it can. What is in a
    nested dataclass is not looked at."""
    plain, may_be_none = bare(kind)
    if value is None and may_be_none:
        return None
    if not _is_a(value, plain):
        return f"{in_words(plain)} is expected, not {_shown(value)}"
    for number in _numbers(value):
        if not _is_finite(number):
            return f"must be a finite number, not {_shown(number)}"
        for bound in bounds_of(kind):
            if not bound.holds(number):
                return f"must be {bound}, not {_shown(number)}"
        if plain is int and bounds_of(kind) and number > _LARGEST_WHOLE:
            return f"must be at most {_LARGEST_WHOLE}, not {_shown(number)}"
    return None


def _as_declared(value: Any, plain: Any) -> Any:
    """What files know no type for: lists that are tuples, whole numbers where any will do."""
    if get_origin(plain) is tuple and isinstance(value, list):
        items = get_args(plain)
        kinds = [items[0]] * len(value) if items[-1] is ... else [*items, *[None] * len(value)]
        return tuple(map(_as_declared, value, kinds))
    return float(value) if plain is float and type(value) is int and abs(value) < 2**53 else value


def in_words(plain: Any) -> str:
    """A bare type, for people."""
    if get_origin(plain) is Literal:
        return "one of " + ", ".join(get_args(plain))
    if get_origin(plain) is tuple:
        items = get_args(plain)
        number = "" if items[-1] is ... else f"{len(items)} "
        return f"a list of {number}values"
    return {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}.get(
        plain, f"a {_name(plain)}"
    )


def _name(plain: Any) -> str:
    return getattr(plain, "__name__", str(plain))


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _is_a(value: Any, plain: Any) -> bool:
    if get_origin(plain) is Literal:
        return isinstance(value, str) and value in get_args(plain)
    if get_origin(plain) is tuple:
        return isinstance(value, tuple) and _are(value, get_args(plain))
    if plain is float:
        return isinstance(value, Real) and not isinstance(value, bool)
    if plain is int:
        return isinstance(value, Integral) and not isinstance(value, bool)
    return isinstance(value, plain)


def _are(values: tuple[Any, ...], items: tuple[Any, ...]) -> bool:
    if items[-1] is ...:
        return all(_is_a(value, items[0]) for value in values)
    return len(values) == len(items) and all(map(_is_a, values, items))


def _is_finite(number: float | int) -> bool:
    try:
        return math.isfinite(number)
    except OverflowError:  # a whole number of more than 308 digits
        return False


def _numbers(value: Any) -> Iterator[Any]:
    """The numbers in a value; those of numpy as Python's."""
    if isinstance(value, tuple):
        for item in value:
            yield from _numbers(item)
    elif isinstance(value, Real) and not isinstance(value, bool):
        yield int(value) if isinstance(value, Integral) else float(value)
