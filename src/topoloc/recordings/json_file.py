"""Read and validate JSON files of other programs.

The `where` argument names the position of a value in error messages.
"""

from __future__ import annotations

import json
import math
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from jaxtyping import Float

from topoloc.errors import TopolocError, TrajectoryError
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.text_files import read_text


def read_json(path: Path, error: type[TopolocError], missing: str = "no such file") -> Any:
    """Return the content of a JSON file. Raises `error` with the file name if it is missing, not
    JSON, or nested too deeply."""
    try:
        return json.loads(read_text(path, error, missing))
    except (ValueError, RecursionError) as failure:
        raise error(f"{path}: not a JSON file ({str(failure)[:120]})") from None


def json_numbers(
    value: Any, count: int, where: str, error: type[TopolocError]
) -> Float[np.ndarray, " n"]:
    """Return a list of `count` finite numbers as an array. Raises `error` otherwise."""
    try:
        numbers = np.array(value, dtype=np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
        numbers = np.zeros(0)
    if len(numbers) != count or not np.isfinite(numbers).all() or isinstance(value, str):
        raise error(f"{where}: {count} finite numbers are expected, not {str(value)[:60]}")
    return numbers


def json_number(value: Any, where: str, error: type[TopolocError]) -> float:
    """Return a finite number. Raises `error` otherwise."""
    try:
        number = (
            math.nan
            if isinstance(value, bool) or not isinstance(value, int | float)
            else float(value)
        )
    except OverflowError:  # an integer of hundreds of digits
        number = math.inf
    if not math.isfinite(number):
        raise error(f"{where}: a finite number is expected, not {str(value)[:40]}")
    return number


def json_rigid(value: Any, where: str, error: type[TopolocError]) -> Rigid3:
    """Return the transform of a 4x4 (or 3x4) matrix, in metres. Raises `error` otherwise."""
    rows = value if isinstance(value, list) else []
    matrix = json_numbers(rows, 16 if len(rows) == 4 else 12, where, error).reshape(-1, 4)
    if len(matrix) == 4 and not np.allclose(matrix[3], [0.0, 0.0, 0.0, 1.0], atol=1e-6):
        raise error(f"{where}: the last row of a pose is 0 0 0 1; is this matrix transposed?")
    try:
        return Rigid3.from_matrix(matrix)
    except TrajectoryError as failure:
        raise error(f"{where}: {failure}") from None


def parse_relative_path(name: Any, where: str, error: type[TopolocError]) -> str:
    """Return a file name that stays inside its folder. Raises `error` otherwise."""
    path = PurePath(name) if isinstance(name, str) else None
    if (
        path is None
        or not path.parts
        or path.is_absolute()
        or ".." in path.parts
        or "\0" in str(path)
        or "\\" in str(path)
    ):
        raise error(f"{where}: {str(name)[:80]!r} is no picture below this folder")
    return path.as_posix()
