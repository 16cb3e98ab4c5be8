"""Bounds of settings: declared beside the field, `Annotated[float, Above(0)]`, and held by one function, `check_bounds`.

Whatever its bounds, no number may be NaN or infinite, and none so large that it does not fit into 32 bits where it is whole.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from topoloc.errors import ConfigError

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


@dataclass(frozen=True)
class Fitted:
    """Fitted to data, hence no setting: files cannot set it, and any finite number will do."""

    def holds(self, number: float | int) -> bool:
        return True

    def __str__(self) -> str:
        return "fitted to data"


Bound = Above | AtLeast | Between | Fitted


def check_bounds(config: Any, name: str | None = None) -> None:
    """Hold that every value of a configuration (a dataclass, and those in it) is of its type and within its bounds.

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


@cache
def annotations_of(kind: type) -> dict[str, Any]:
    """The fields of a dataclass, in their order, with what they are declared as, bounds and all."""
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in fields(kind)}


def bounds_of(kind: Any) -> list[Bound]:
    """What an annotation says beside the type."""
    return [extra for extra in get_args(kind)[1:] if isinstance(extra, Bound)] if get_origin(kind) is Annotated else []


def bare(kind: Any) -> tuple[Any, bool]:
    """The type that an annotation names, without bounds and None, and whether None is allowed."""
    if get_origin(kind) is Annotated:
        kind = get_args(kind)[0]
    if get_origin(kind) in (Union, UnionType):
        others = [choice for choice in get_args(kind) if choice is not NoneType]
        return (others[0] if len(others) == 1 else Union[tuple(others)]), NoneType in get_args(kind)  # noqa: UP007
    return kind, False


def complaint(value: Any, kind: Any) -> str | None:
    """Why `value` cannot be that of a field declared as `kind`; None where it can. What is in a nested dataclass is not looked at."""
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
        if plain is int and number > _LARGEST_WHOLE:
            return f"must be at most {_LARGEST_WHOLE}, not {_shown(number)}"
    return None


def in_words(plain: Any) -> str:
    """A bare type, for people."""
    if get_origin(plain) is Literal:
        return "one of " + ", ".join(get_args(plain))
    if get_origin(plain) is tuple:
        items = get_args(plain)
        number = "" if items[-1] is ... else f"{len(items)} "
        return f"a list of {number}values"
    return {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}.get(plain, f"a {_name(plain)}")


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
