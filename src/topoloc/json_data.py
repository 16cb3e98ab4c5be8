"""Decode untrusted JSON into msgspec structs and other annotated types.

msgspec checks types, bounds and keys. NaN and infinity pass it unless a number has bounds, so
numbers are annotated as `Finite`.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import Meta

from topoloc.errors import TopolocError

T = TypeVar("T")

Finite = Annotated[float, Meta(ge=-1e300, le=1e300)]
NonNegative = Annotated[float, Meta(ge=0, le=1e300)]
Positive = Annotated[float, Meta(gt=0, le=1e300)]
Count = Annotated[int, Meta(ge=0, lt=2**53)]
"""A whole number that every JSON reader represents exactly."""
Nanoseconds = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
MatrixRow = tuple[Finite, Finite, Finite, Finite]
Matrix34 = tuple[MatrixRow, MatrixRow, MatrixRow]
"""Rows of a rigid transform."""
_Row6 = Annotated[list[Finite], Meta(min_length=6, max_length=6)]
Matrix66 = Annotated[list[_Row6], Meta(min_length=6, max_length=6)]


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
        return msgspec.convert(parsed, kind)
    except (ValueError, RecursionError, TopolocError) as failure:
        fault, _, path = " ".join(str(failure).split()).partition(" - at `$")
        if fault.endswith("1e+300"):
            fault = "a finite number is expected"
        place = f"{path.strip('.`')[:100]}: " if path else ""
        raise error(f"{where}: {place}{fault[:200]}") from None
