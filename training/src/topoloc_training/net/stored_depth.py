"""Depth of every fourth pixel of a rendered picture, as `topoloc_worlds.wide_views` stores it:
16-bit logarithms, as differences along the rows. A step is 0.05 %."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

STEP, FIRST = 4, 1
"""Pixels of columns and rows 1, 5, 9 ..."""
_UNIT, _NEAREST = math.log(4000) / 65000, 0.1


def read_depth(path: Path) -> Float[np.ndarray, "h4 w4"]:
    """Return metres at every fourth pixel, 0 where there is none."""
    differences = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert differences is not None, path
    coded = np.cumsum(differences, axis=1, dtype=np.uint16).astype(np.float32)
    return np.where(coded > 0, _NEAREST * np.exp(coded * _UNIT), 0).astype(np.float32)
