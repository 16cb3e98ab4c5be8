"""Compiled inner loop of `clustered_errors`."""

import numpy as np

from topoloc.compiled import kernel
from topoloc.geometry.absolute_pose_kernels import normal_equations


@kernel()
def squared_pulls(rotation, translation, normalized, covariances, points_world, point_covariances, cells, num_cells, cauchy_scale):
    """The information (6, 6) of all matches, and of the gradients by which they pull at the pose, less their mean, the sums of squares
    g g' of single matches and of those of one cell together."""
    count = len(normalized)
    active = np.ones(1, np.bool_)
    information, alone, together = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6))
    pulls, of_cells = np.zeros((count, 6)), np.zeros((num_cells, 6))
    for i in range(count):
        own, pulls[i], _, _ = normal_equations(
            rotation,
            translation,
            normalized[i : i + 1],
            covariances[i : i + 1],
            points_world[i : i + 1],
            point_covariances[i : i + 1],
            active,
            cauchy_scale,
            6,
        )
        information += own
    mean = pulls.sum(axis=0) / max(count, 1)
    for i in range(count):
        for a in range(6):
            pulls[i, a] -= mean[a]
            of_cells[cells[i], a] += pulls[i, a]
    for a in range(6):
        for b in range(6):
            for i in range(count):
                alone[a, b] += pulls[i, a] * pulls[i, b]
            for c in range(num_cells):
                together[a, b] += of_cells[c, a] * of_cells[c, b]
    return information, alone, together
