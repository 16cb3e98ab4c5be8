"""Depth of every fourth pixel of a rendered picture, in a small file: 16-bit logarithms, as
differences along the rows. A step is 0.05 %."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

STEP, FIRST = 4, 1
"""Pixels of columns and rows 1, 5, 9 ..."""
_UNIT, _NEAREST = math.log(4000) / 65000, 0.1
_LAST = 65000


def store_depth(path: Path, depth: Float[np.ndarray, "h w"]) -> None:
    """Store depth as PNG: metres from 0.1 to 400, anything else (NaN in the sky) is none."""
    known = np.nan_to_num(depth[FIRST::STEP, FIRST::STEP])
    coded = np.rint(np.log(np.maximum(known, _NEAREST) / _NEAREST) / _UNIT).astype(np.int64)
    is_known = (known > _NEAREST) & (coded < _LAST)
    coded = np.where(is_known, coded // 4 * 4 + 2, 0).astype(np.uint16)
    coded[:, 1:] -= coded[:, :-1].copy()
    cv2.imwrite(str(path), coded, [cv2.IMWRITE_PNG_COMPRESSION, 9])


def read_depth(path: Path) -> Float[np.ndarray, "h4 w4"]:
    """Return metres at every fourth pixel, 0 where there is none."""
    differences = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert differences is not None, path
    coded = np.cumsum(differences, axis=1, dtype=np.uint16).astype(np.float32)
    return np.where(coded > 0, _NEAREST * np.exp(coded * _UNIT), 0).astype(np.float32)
