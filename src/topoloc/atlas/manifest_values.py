"""Check the values of a manifest. Each function raises ValueError with the name of the value."""

from __future__ import annotations

import math
import re
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from topoloc.geometry.rigid import Rigid3

ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")
"""Pattern of tile ids and world names."""
_MAX_METRES = 1e8

T = TypeVar("T")


def of(kind: type[T], value: Any, what: str) -> T:
    """Return a value that must have this type."""
    if not isinstance(value, kind):
        raise ValueError(f"{what} is no {kind.__name__}")
    return value


def matching(pattern: re.Pattern[str], value: Any, what: str) -> str:
    """Return a text that must match the whole pattern."""
    if not isinstance(value, str) or not pattern.fullmatch(value):
        raise ValueError(f"{what} cannot be {str(value)[:80]!r}")
    return value


def count(value: Any, what: str) -> int:
    """Return a non-negative integer below 2**53, which every JSON reader represents exactly."""
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**53:
        raise ValueError(f"{what} is no count")
    return value


def number(value: Any, what: str) -> float:
    """Return a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{what} is no finite number")
    return float(value)


def parse_pose(rows: Any, what: str) -> Rigid3:
    """Parse a 3x4 pose.

    Raises:
        ValueError, TrajectoryError: it is no pose.
    """
    matrix = np.array(rows, np.float64)
    pose = Rigid3.from_matrix(matrix)
    if np.abs(pose.translation).max() > _MAX_METRES:
        raise ValueError(f"{what} is further away than the earth is wide")
    return pose


def parse_covariance(rows: Any, what: str, is_definite: bool) -> Float[np.ndarray, "6 6"]:
    """Parse a 6x6 covariance and make it exactly symmetric.

    Raises:
        ValueError: it is no covariance.
    """
    matrix = np.array(rows, np.float64)
    if (
        matrix.shape != (6, 6)
        or not np.isfinite(matrix).all()
        or np.abs(matrix).max() > _MAX_METRES**2
    ):
        raise ValueError(f"{what} is no 6x6 matrix of finite numbers")
    symmetric = 0.5 * (matrix + matrix.T)
    values = np.linalg.eigvalsh(symmetric)
    slack = 1e-9 * max(float(values[-1]), 0.0)
    if (
        np.abs(matrix - symmetric).max() > slack
        or values[0] < -slack
        or (is_definite and values[0] <= 0.0)
    ):
        raise ValueError(f"{what} is no covariance")
    return symmetric
