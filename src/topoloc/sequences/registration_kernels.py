"""Numba kernels of depth registration: one pass over a depth picture's pixels each, no array in between but the points."""

from __future__ import annotations

import numpy as np

from topoloc.compiled import kernel


@kernel(error_model="numpy")
def back_project(depth, normalized, rotation, translation, points):
    """Fill `points` (n, 3) with what the known pixels see, in the other camera's frame; returns n.

    `normalized` (h * w, 2) are the pixels on the depth camera's plane z = 1; `points` has room for every pixel.
    """
    height, width = depth.shape
    count = 0
    for row in range(height):
        for column in range(width):
            z = np.float64(depth[row, column])
            if not z > 0.0:  # NaN compares false
                continue
            x, y = normalized[row * width + column, 0] * z, normalized[row * width + column, 1] * z
            for axis in range(3):
                points[count, axis] = rotation[axis, 0] * x + rotation[axis, 1] * y + rotation[axis, 2] * z + translation[axis]
            count += 1
    return count


@kernel(error_model="numpy")
def keep_nearest(pixels, points, registered):
    """Write each point's z into `registered` at its rounded pixel (NaN: none), where nothing nearer is."""
    height, width = registered.shape
    for i in range(len(pixels)):
        x, y = pixels[i, 0], pixels[i, 1]
        if not (x >= -0.5 and y >= -0.5 and x < width - 0.5 and y < height - 0.5):
            continue
        row, column = int(np.rint(y)), int(np.rint(x))
        z = np.float32(points[i, 2])
        if not registered[row, column] <= z:  # also where it is still NaN
            registered[row, column] = z
