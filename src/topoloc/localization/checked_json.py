"""Read values from untrusted JSON.

Each function checks the type and bounds and raises ResultError with the key otherwise.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from topoloc.errors import ResultError, TrajectoryError
from topoloc.geometry.rigid import Rigid3

MAX_ITEMS = 10_000


def parse_object(line: str | bytes | Mapping[str, Any]) -> Mapping[str, Any]:
    """Parse a JSON line into an object. An object that is already parsed is returned as is."""
    data: Any = line
    if isinstance(line, str | bytes):
        try:
            data = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise ResultError(
                f"no result: not JSON ({' '.join(str(error).split())[:100]})"
            ) from None
    if not isinstance(data, Mapping):
        raise ResultError(f"no result: a JSON object is expected, not {type(data).__name__}")
    return data


def mapping(value: Any, key: str) -> Mapping[str, Any]:
    """Return a value that must be a JSON object."""
    if not isinstance(value, Mapping):
        raise ResultError(f"no result: {key!r} is no object")
    return value


def require(data: Mapping[str, Any], key: str) -> Any:
    """Return the value of a required key."""
    if key not in data:
        raise ResultError(f"no result: {key!r} is missing")
    return data[key]


def number(
    value: Any, key: str, min_value: float = -math.inf, max_value: float = math.inf
) -> float:
    """Return a value that must be a finite number within bounds."""
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float)
        or not min_value <= value <= max_value
        or abs(value) > 1e300
    ):  # NaN fails
        raise ResultError(f"no result: {key!r} is no number{_range_text(min_value, max_value)}")
    return float(value)


def integer(value: Any, key: str, min_value: int = 0, max_value: int = 2**63 - 1) -> int:
    """Return a value that must be an integer within bounds."""
    if isinstance(value, bool) or not isinstance(value, int) or not min_value <= value <= max_value:
        raise ResultError(
            f"no result: {key!r} is no integer{_range_text(float(min_value), float(max_value))}"
        )
    return value


def text(value: Any, key: str) -> str:
    """Return a value that must be a text."""
    if not isinstance(value, str):
        raise ResultError(f"no result: {key!r} is no text")
    return value


def items(value: Any, key: str) -> list[Any]:
    """Return a value that must be a list of at most `MAX_ITEMS` entries."""
    if not isinstance(value, list | tuple) or len(value) > MAX_ITEMS:
        raise ResultError(f"no result: {key!r} is no list of at most {MAX_ITEMS}")
    return list(value)


def pose_from_json(value: Any, key: str) -> Rigid3:
    """Parse a pose ``{"translation": [x, y, z], "quat_wxyz": [w, x, y, z]}``, translation in
    metres. `key` is its name in errors. Raises ResultError."""
    data = value if isinstance(value, Mapping) else {}
    quat_wxyz = [
        number(one, f"{key}.quat_wxyz") for one in items(data.get("quat_wxyz"), f"{key}.quat_wxyz")
    ]
    translation = [
        number(one, f"{key}.translation")
        for one in items(data.get("translation"), f"{key}.translation")
    ]
    if len(quat_wxyz) != 4 or len(translation) != 3 or not abs(math.hypot(*quat_wxyz) - 1.0) < 1e-3:
        raise ResultError(
            f"no result: {key!r} needs a translation of 3 numbers and a unit quat_wxyz of 4"
        )
    try:
        return Rigid3.from_quat_wxyz(np.array(quat_wxyz), np.array(translation))
    except TrajectoryError as error:
        raise ResultError(f"no result: {key!r}: {error}") from None


def pose_to_json(world_from_cam: Rigid3) -> dict[str, list[float]]:
    """Return a pose in the common JSON format (metres), as `pose_from_json` reads it."""
    return {
        "translation": world_from_cam.translation.tolist(),
        "quat_wxyz": world_from_cam.quat_wxyz().tolist(),
    }


def covariance(value: Any, key: str) -> Float[np.ndarray, "6 6"]:
    """Return a symmetric 6x6 matrix without negative variances."""
    rows = [[number(one, key) for one in items(row, key)] for row in items(value, key)]
    if len(rows) != 6 or any(len(row) != 6 for row in rows):
        raise ResultError(f"no result: {key!r} is no 6x6 matrix")
    matrix = np.array(rows)
    diagonal = np.diag(matrix)
    if (diagonal < 0.0).any() or (
        np.abs(matrix - matrix.T) > 1e-6 * np.sqrt(np.outer(diagonal, diagonal)) + 1e-300
    ).any():
        raise ResultError(f"no result: {key!r} is not symmetric, or has a negative variance")
    return matrix


def _range_text(min_value: float, max_value: float) -> str:
    return (
        ""
        if math.isinf(min_value) and math.isinf(max_value)
        else f" from {min_value:g} to {max_value:g}"
    )
