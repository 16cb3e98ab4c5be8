"""Numba kernels of depth registration. Each makes one pass over the pixels or points."""

import numpy as np

from topoloc.compiled import kernel


@kernel(error_model="numpy")
def back_project(depth, normalized, rotation, translation, points):
    """Fill `points` (n, 3) with the points of known depth, in the other camera's frame. Return n.

    `normalized` (h * w, 2) holds the pixels on the depth camera's plane z = 1. `points` has a row
    for every pixel.
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
                points[count, axis] = (
                    rotation[axis, 0] * x
                    + rotation[axis, 1] * y
                    + rotation[axis, 2] * z
                    + translation[axis]
                )
            count += 1
    return count


@kernel(error_model="numpy", inline="always")
def _update_z_buffer_pixel(x, y, depth, registered):
    height, width = registered.shape
    if x >= -0.5 and y >= -0.5 and x < width - 0.5 and y < height - 0.5:
        row, column = int(np.rint(y)), int(np.rint(x))
        z = np.float32(depth)
        if not registered[row, column] <= z:  # also true for NaN
            registered[row, column] = z


@kernel(error_model="numpy")
def register_undistorted(depth, normalized, rotation, translation, focal, centre, registered):
    """Register depth to a camera without distortion in one pass.

    Combines `back_project`, the projection (focal lengths and principal point, x and y) and
    `update_z_buffer` without storing points. The results are bit-identical.
    """
    height, width = depth.shape
    for row in range(height):
        for column in range(width):
            z = np.float64(depth[row, column])
            if not z > 0.0:  # NaN compares false
                continue
            x, y = normalized[row * width + column, 0] * z, normalized[row * width + column, 1] * z
            px = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0]
            py = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1]
            pz = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2]
            if pz > 1e-9:
                _update_z_buffer_pixel(
                    px / pz * focal[0] + centre[0], py / pz * focal[1] + centre[1], pz, registered
                )


@kernel(error_model="numpy")
def update_z_buffer(pixels, points, registered):
    """Write the z of each point to `registered` at its rounded pixel, if no nearer point is there.
    NaN marks empty pixels."""
    for i in range(len(pixels)):
        _update_z_buffer_pixel(pixels[i, 0], pixels[i, 1], points[i, 2], registered)
