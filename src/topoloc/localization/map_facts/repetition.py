"""Where a place repeats itself: a wall of equal panels, a row of equal windows, tiles; and the same
wall on the other side of the house.

No picture of such a wall tells one panel from the next. Its features fail the ratio test, since the
next panel has the same ones, and a pose that is found all the same is one of many. So for each node
it is looked up once how the place can be moved onto itself:

- by **shifts**: its points that look like other points nearby vote for the shift between the two,
  and what many points vote for is one;
- by **moves** in general: it is localized by nodes far from it that look like it. Where it is found
  among their points, as if it were there, it has a copy there.

A hypothesis there is not alone: the poses moved so are proposed as well (`propose.py`), and a match
with any copy of a point speaks for all of them (`refine.py`). What tells them apart is what does
not repeat itself, if the picture shows any of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from topoloc.features.matching import MatchingConfig, find_similar_pairs, match_features
from topoloc.geometry.absolute_pose import AbsolutePoseConfig, estimate_absolute_pose
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.local_map import LocalMap
from topoloc.mapping.entries import NodeSummary, TopoNode
from topoloc.mapping.nodes import compute_nodes_digest

NUM_NEIGHBOURS = 9
MIN_SHIFT = 0.3
"""Metres: from there on a copy is another place."""
_NUM_POINTS = 128
_MIN_SIMILARITY = 0.9
_CELL = 0.1  # metres
_MIN_VOTES, _MIN_SELF_SHARE = 12, 0.15
_MAX_SHIFTS = 6
_MIN_COPIED, _MIN_COPIED_SHARE = 20, 0.3
_NEAREST_NEIGHBOR = MatchingConfig(ratio=0.0, mutual=False)
_POSE = AbsolutePoseConfig(max_reprojection_error_px=6.0, max_iterations=500)
_METHOD = 1  # part of the digest: one more whenever the same nodes come to have other repetitions
_MAX_CELL_OFFSET = 1000  # cells to either side: more than any shift is long


def digest_of(summaries: Sequence[NodeSummary]) -> str:
    """A short name for what repetitions follow from."""
    return compute_nodes_digest(summaries, bytes([_METHOD]))


def has_repetitions(node: LocalMap) -> bool:
    """Is there anything in what a node shows that its own picture shows twice? What repeats itself
    mostly does."""
    return len(find_repetition_shifts(node, node, _MIN_SELF_SHARE)) > 0


def find_repetition_shifts(
    node: LocalMap, neighbours: LocalMap, min_share: float = 0.5
) -> Float[np.ndarray, "k 3"]:
    """The shifts (metres, world) by which what a node shows is there once more, those with most
    votes first; none in most places.

    Args:
        around: the points of the nodes nearby that look the same way.
        min_share: of the node's points must find a copy by the first shift, half as many by each
            other one: parts of a panel may resemble each other, too, and smooth surfaces any part
            of themselves.
    """
    points, descriptors = node.points_world[:_NUM_POINTS], node.descriptors[:_NUM_POINTS]
    rows, columns = find_similar_pairs(descriptors, neighbours.descriptors, _MIN_SIMILARITY)
    shifts = neighbours.points_world[columns] - points[rows]
    far = np.linalg.norm(shifts, axis=1) > MIN_SHIFT
    rows, shifts = rows[far], shifts[far]
    found: list[Float[np.ndarray, " 3"]] = []
    least, left = max(_MIN_VOTES, min_share * len(points)), np.ones(len(shifts), np.bool_)
    grids = [
        _ShiftVotes.of(shifts, rows, offset) for offset in (0.0, 0.5)
    ]  # that overlap: no shift lies at the borders of both
    while left.any() and len(found) < _MAX_SHIFTS:
        _, voters = max((grid.find_densest_cell(left) for grid in grids), key=lambda most: most[0])
        near = left & (
            np.linalg.norm(shifts - np.median(shifts[voters], axis=0), axis=1) < 1.5 * _CELL
        )
        votes = len(np.unique(rows[near]))
        if votes < least:
            break
        if not found:
            least = max(_MIN_VOTES, 0.5 * votes)
        found.append(np.median(shifts[near], axis=0))
        left &= np.linalg.norm(shifts - found[-1], axis=1) > 3.0 * _CELL
    return np.array(found).reshape(-1, 3)


def find_copy_transform(node: TopoNode, others: LocalMap) -> Rigid3 | None:
    """The move (world) that takes what a node shows onto its copy among these points; None where
    there is none, or it is itself."""
    features = node.features.select(np.arange(min(_NUM_POINTS, len(node.features))))
    matches = match_features(features.descriptors, others.descriptors, _NEAREST_NEIGHBOR)
    alike = 1.0 - matches.distances**2 / 2.0 >= _MIN_SIMILARITY
    rows, columns = matches.query_idx[alike], matches.train_idx[alike]
    least = max(_MIN_COPIED, _MIN_COPIED_SHARE * len(features))
    if len(rows) < least:
        return None
    points_img = features.points_img[rows].astype(np.float64)
    points_world, covariances = others.points_world[columns], others.covariances[columns]
    found = estimate_absolute_pose(
        points_img, points_world, node.camera, _POSE, point_covariances=covariances
    )
    if found is None or np.count_nonzero(found.inliers) < least:
        return None
    move = found.cam_from_world.inverse() @ node.summary.world_from_cam.inverse()
    points_world = node.summary.world_from_cam.apply(
        node.points_cam[rows[found.inliers]].astype(np.float64)
    )
    displacements = np.linalg.norm(move.apply(points_world) - points_world, axis=1)
    return move if float(np.median(displacements)) > MIN_SHIFT else None


@dataclass(frozen=True, eq=False)
class _ShiftVotes:
    """Shifts by the cells of a grid that they lie in: `order` sorts them by cell and point, `cells`
    and `points` are sorted so."""

    order: Int[np.ndarray, " n"]
    cells: Int[np.ndarray, " n"]
    points: Int[np.ndarray, " n"]

    @staticmethod
    def of(
        shifts: Float[np.ndarray, "n 3"], rows: Int[np.ndarray, " n"], offset: float
    ) -> _ShiftVotes:
        x, y, z = (np.floor(shifts / (2.0 * _CELL) + offset).astype(np.int64) + _MAX_CELL_OFFSET).T
        keys = ((x * 2 * _MAX_CELL_OFFSET + y) * 2 * _MAX_CELL_OFFSET + z) * _NUM_POINTS + rows
        order = np.argsort(keys, kind="stable")
        return _ShiftVotes(order, *np.divmod(keys[order], _NUM_POINTS))

    def find_densest_cell(self, left: Bool[np.ndarray, " n"]) -> tuple[int, Int[np.ndarray, " k"]]:
        """The most points that vote for one cell, and the shifts that lie in it, of those that are
        left (some are)."""
        is_left = left[self.order]
        cells, points = self.cells[is_left], self.points[is_left]
        begins = np.append(True, cells[1:] != cells[:-1])
        votes = np.add.reduceat(
            begins | np.append(True, points[1:] != points[:-1]),
            np.flatnonzero(begins),
            dtype=np.int64,
        )
        cell = cells[begins][votes.argmax()]
        return int(votes.max()), self.order[is_left & (self.cells == cell)]


def fold_repetitions(
    points_world: Float[np.ndarray, "n 3"], shifts: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, "n 3"]:
    """The points with all copies moved onto one: along the shortest shift, by whole shifts, into
    one period of it."""
    if len(shifts) == 0:
        return points_world
    shift = shifts[np.argmin(np.linalg.norm(shifts, axis=1))]
    along = points_world @ shift / (shift @ shift)
    fractions = np.sort(along % 1.0)
    # cut where fewest points are: a copy on either side of the cut would be a period off
    gap = int(np.argmax(np.diff(fractions, append=fractions[:1] + 1.0))) if len(fractions) else 0
    cut = fractions[gap] + 1e-6 if len(fractions) else 0.0
    return points_world - np.floor(along - cut)[:, None] * shift


def shifted_copies(
    points_world: Float[np.ndarray, "n 3"], shifts: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, "c n 3"]:
    """The points themselves, and moved by each shift."""
    return np.stack([points_world, *(points_world + shift for shift in shifts)])
