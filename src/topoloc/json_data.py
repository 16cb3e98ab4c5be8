"""Decode untrusted JSON into msgspec structs and other annotated types.

msgspec checks types, bounds and keys. NaN and infinity pass it unless a number has bounds, so
numbers are annotated as `Finite`. Arrays are annotated with their shapes, and poses as `Rigid3`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection
from typing import Annotated, Any, ClassVar, TypeVar

import msgspec
import numpy as np
from msgspec import Meta

from topoloc.errors import TopolocError

T = TypeVar("T")

Finite = Annotated[float, Meta(ge=-1e300, le=1e300)]
NonNegative = Annotated[float, Meta(ge=0, le=1e300)]
Positive = Annotated[float, Meta(gt=0, le=1e300)]
Count = Annotated[int, Meta(ge=0, lt=2**53)]
"""A whole number that every JSON reader represents exactly."""
Nanoseconds = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]


def decode_json(
    data: Any, kind: Callable[..., T], error: Callable[[str], Exception], where: str
) -> T:
    """Decode JSON and check it.

    Args:
        data: JSON as text or bytes, or an object that is already parsed.
        kind: type of the result: a struct, a dataclass, or a type such as ``dict[str, Finite]``.
        error: class of the error.
        where: name of the data, at the beginning of the error.

    Raises:
        error: the data are not JSON, are nested too deeply, or are not of this type. The text is
            one line with `where`, the path of the value and the fault.
    """
    try:
        parsed = json.loads(data) if isinstance(data, str | bytes) else data
    except (ValueError, RecursionError) as failure:
        raise error(f"{where}: not JSON ({str(failure)[:100]})") from None
    try:
        return msgspec.convert(parsed, kind, dec_hook=_decode_custom)
    except (ValueError, RecursionError, TopolocError) as failure:
        fault, _, path = " ".join(str(failure).split()).partition(" - at `$")
        if fault.endswith("1e+300"):
            fault = "a finite number is expected"
        place = f"{path.strip('.`')[:100]}: " if path else ""
        raise error(f"{where}: {place}{fault[:200]}") from None


def encode_json(value: Any) -> Any:
    """Return a struct or dataclass as objects that `json.dumps` takes. Arrays and poses become
    lists of rows."""
    return msgspec.to_builtins(value, enc_hook=lambda custom: custom.tolist())


def _decode_custom(kind: Any, value: Any) -> Any:
    """Decode a value of a class with `from_json`, or a jaxtyping array of its shape."""
    if isinstance(value, str):  # `from_json` would decode it once more
        raise ValueError(f"Expected `{kind.__name__}`, got `str`")
    if hasattr(kind, "from_json"):
        try:
            return kind.from_json(value)
        except TopolocError as error:
            raise ValueError(str(error)) from None
    array = np.array(value)
    is_finite = array.dtype.kind in "iuf" and np.isfinite(array).all()
    if not is_finite or not isinstance(array := array.astype(np.float64), kind):
        raise ValueError(f"finite numbers of shape ({kind.dim_str}) are expected")
    return array


class OneLine:
    """A base of structs and of dataclasses with `repr=False`: they print as one line of less than
    200 characters. Of long lists and arrays it has the length, so that no file is read."""

    __slots__ = ()
    __match_args__: ClassVar[tuple[str, ...]]

    def __repr__(self) -> str:
        shown = (f"{name}={_shorten(getattr(self, name))}" for name in type(self).__match_args__)
        text = f"{type(self).__name__}({', '.join(shown)})"
        return text if len(text) < 200 else f"{text[:195]}...)"


def _shorten(value: object) -> str:
    if isinstance(value, np.ndarray) or (isinstance(value, Collection) and len(value) > 12):
        return repr(value) if isinstance(value, str) else f"{type(value).__name__} of {len(value)}"
    text = f"[{', '.join(map(_shorten, value))}]" if isinstance(value, list) else repr(value)
    return text if len(text) <= 120 and "\n" not in text else f"{type(value).__name__}(...)"
