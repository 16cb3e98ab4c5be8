"""Where a place repeats itself: a wall of equal panels, a row of equal windows, tiles.

No picture of such a wall tells one panel from the next. Its features fail the ratio test, since the next panel has the same ones, and a
pose that is found all the same is one of many. So for each node it is looked up once by which shifts what it shows repeats itself: its
points that look like other points nearby vote for the shift between the two, and a repetition is a shift that many points vote for.
A hypothesis there is not alone: the poses shifted so are proposed as well (`propose.py`), and a match with any copy of a point speaks for
all of them (`refine.py`). What tells them apart is what does not repeat itself, if the picture shows any of it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from topoloc.localization.local_map import LocalMap

NUM_NEIGHBOURS = 9
_NUM_POINTS = 128
_MIN_SIMILARITY = 0.9
_CELL = 0.1  # metres; and a share of the shift's own length
_MIN_VOTES, _MIN_VOTE_SHARE = 12, 0.15
_MAX_SHIFTS = 6
_HALF = 1000  # cells to either side: more than any shift is long


def shifts_of(node: LocalMap, around: LocalMap, min_shift: float) -> Float[np.ndarray, "k 3"]:
    """The shifts (metres, world) by which what a node shows is there once more, those with most votes first; none in most places.

    Args:
        around: the points of the nodes nearby that look the same way. min_shift: metres; a smaller shift is no other place.
    """
    points, descriptors = node.points_world[:_NUM_POINTS], node.descriptors[:_NUM_POINTS]
    rows, columns = np.nonzero(descriptors @ around.descriptors.T >= _MIN_SIMILARITY)
    shifts = around.points_world[columns] - points[rows]
    far = np.linalg.norm(shifts, axis=1) > min_shift
    rows, shifts = rows[far], shifts[far]
    found: list[Float[np.ndarray, " 3"]] = []
    least = max(_MIN_VOTES, _MIN_VOTE_SHARE * len(points))
    while len(shifts) and len(found) < _MAX_SHIFTS:
        centre = _densest(shifts, rows)
        near = np.linalg.norm(shifts - centre, axis=1) < 1.5 * _CELL
        if len(np.unique(rows[near])) < least:
            break
        found.append(np.median(shifts[near], axis=0))
        kept = np.linalg.norm(shifts - found[-1], axis=1) > max(0.5 * min_shift, 3.0 * _CELL)
        rows, shifts = rows[kept], shifts[kept]
    return np.array(found).reshape(-1, 3)


def _densest(shifts: Float[np.ndarray, "n 3"], rows: np.ndarray) -> Float[np.ndarray, " 3"]:
    """The middle of the cell that most points vote for, of two grids that overlap."""
    best, most = shifts[0], 0
    for offset in (0.0, 0.5):
        cells = np.floor(shifts / (2.0 * _CELL) + offset).astype(np.int64) + _HALF
        keys = (cells[:, 0] * 2 * _HALF + cells[:, 1]) * 2 * _HALF + cells[:, 2]
        votes = np.unique(keys * _NUM_POINTS + rows) // _NUM_POINTS  # of each point once a cell
        found, counts = np.unique(votes, return_counts=True)
        if counts.max() > most:
            most = int(counts.max())
            best = np.median(shifts[keys == found[counts.argmax()]], axis=0)
    return best


def folded(points_world: Float[np.ndarray, "n 3"], shifts: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "n 3"]:
    """The points with all copies moved onto one: along the shortest shift, by whole shifts, into one period of it."""
    if len(shifts) == 0:
        return points_world
    shift = shifts[np.argmin(np.linalg.norm(shifts, axis=1))]
    along = points_world @ shift / (shift @ shift)
    fractions = np.sort(along % 1.0)
    # cut where fewest points are: a copy on either side of the cut would be a period off
    gap = int(np.argmax(np.diff(fractions, append=fractions[:1] + 1.0))) if len(fractions) else 0
    cut = fractions[gap] + 1e-6 if len(fractions) else 0.0
    return points_world - np.floor(along - cut)[:, None] * shift


def copies(points_world: Float[np.ndarray, "n 3"], shifts: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "c n 3"]:
    """The points themselves, and moved by each shift."""
    return np.stack([points_world, *(points_world + shift for shift in shifts)])
