"""Numba kernel: a picture's value between its pixels."""

from __future__ import annotations

import numpy as np

from topoloc.compiled import kernel


@kernel(error_model="numpy", inline="always")  # inlined, it obeys the caller's rules of arithmetic
def sample_bilinear(image, x, y):
    """Bilinear; the caller keeps (x, y) inside."""
    ix, iy = int(x), int(y)
    fx, fy = np.float32(x - ix), np.float32(y - iy)
    top = image[iy, ix] * (1 - fx) + image[iy, ix + 1] * fx
    bottom = image[iy + 1, ix] * (1 - fx) + image[iy + 1, ix + 1] * fx
    return top * (1 - fy) + bottom * fy
