"""Find repetitive places: equal panels, windows or tiles, or the same wall elsewhere.

An image of such a wall cannot distinguish one panel from the next. Its features fail the ratio
test, because the next panel has the same ones. A pose that is found anyway is one of many. So the
transforms that move the place onto itself are computed once for each node:

- by **shifts**: pairs of similar points nearby vote for the shift between them, and shifts with
  many votes are kept
- by **moves** in general: the node is localized with distant nodes that look like it. If it is
  found among their points, it has a copy there.

The moved poses of a hypothesis become proposals too (`propose.py`). A match with any copy of a
point supports all of them (`refine.py`). The non-repetitive parts of the image separate them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from topoloc.features.features import MatchingConfig
from topoloc.features.matching import find_similar_pairs, match_features
from topoloc.geometry.absolute_pose import AbsolutePoseConfig, estimate_absolute_pose
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.pose_fit import LocalMap
from topoloc.mapping.nodes import compute_nodes_digest
from topoloc.mapping.storage.entries import NodeSummary, TopoNode

NUM_NEIGHBOURS = 9
MIN_SHIFT = 0.3
"""Metres. A copy at this distance or more is another place."""
_NUM_POINTS = 128
_MIN_SIMILARITY = 0.9
_CELL = 0.1  # metres
_METHOD = 1  # part of the digest: increase if the same nodes give other repetitions


def digest_of(summaries: Sequence[NodeSummary]) -> str:
    """Return a digest of the inputs of repetitions."""
    return compute_nodes_digest(summaries, bytes([_METHOD]))


def find_repetition_shifts(
    node: LocalMap, neighbours: LocalMap, min_share: float = 0.5
) -> Float[np.ndarray, "k 3"]:
    """Find the shifts (metres, world) that move a node's points onto copies, most votes first.

    Most places have none.

    Args:
        neighbours: points of nearby nodes with a similar viewing direction.
        min_share: share of the node's points that need a copy by the first shift. Each other shift
            needs half the votes of the first. Parts of a panel may be similar, and a smooth surface
            is similar to itself.
    """
    min_votes, max_shifts = 12, 6
    points, descriptors = node.points_world[:_NUM_POINTS], node.descriptors[:_NUM_POINTS]
    rows, columns = find_similar_pairs(descriptors, neighbours.descriptors, _MIN_SIMILARITY)
    shifts = neighbours.points_world[columns] - points[rows]
    far = np.linalg.norm(shifts, axis=1) > MIN_SHIFT
    rows, shifts = rows[far], shifts[far]
    found: list[Float[np.ndarray, " 3"]] = []
    least, left = max(min_votes, min_share * len(points)), np.ones(len(shifts), np.bool_)
    grids = [
        _ShiftVotes.from_shifts(shifts, rows, offset) for offset in (0.0, 0.5)
    ]  # overlap: no shift is at a border of both
    while left.any() and len(found) < max_shifts:
        _, voters = max((grid.find_densest_cell(left) for grid in grids), key=lambda most: most[0])
        near = left & (
            np.linalg.norm(shifts - np.median(shifts[voters], axis=0), axis=1) < 1.5 * _CELL
        )
        votes = len(np.unique(rows[near]))
        if votes < least:
            break
        if not found:
            least = max(min_votes, 0.5 * votes)
        found.append(np.median(shifts[near], axis=0))
        left &= np.linalg.norm(shifts - found[-1], axis=1) > 3.0 * _CELL
    return np.array(found).reshape(-1, 3)


def find_copy_transform(node: TopoNode, others: LocalMap) -> Rigid3 | None:
    """Return the transform (world) that moves a node onto its copy among these points.

    None if there is no copy, or the copy is the node itself.
    """
    features = node.features.select(np.arange(min(_NUM_POINTS, len(node.features))))
    matches = match_features(features.descriptors, others.descriptors, MatchingConfig.nearest())
    alike = 1.0 - matches.distances**2 / 2.0 >= _MIN_SIMILARITY
    rows, columns = matches.query_idx[alike], matches.train_idx[alike]
    least = max(20, 0.3 * len(features))  # number of copied points
    if len(rows) < least:
        return None
    points_img = features.points_img[rows].astype(np.float64)
    points_world, covariances = others.points_world[columns], others.covariances[columns]
    config = AbsolutePoseConfig(max_reprojection_error_px=6.0, max_iterations=500)
    found = estimate_absolute_pose(
        points_img, points_world, node.camera, config, point_covariances=covariances
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
    """Hold shifts by grid cell. `order` sorts them by cell and point, as are `cells` and
    `points`."""

    order: Int[np.ndarray, " n"]
    cells: Int[np.ndarray, " n"]
    points: Int[np.ndarray, " n"]

    @staticmethod
    def from_shifts(
        shifts: Float[np.ndarray, "n 3"], rows: Int[np.ndarray, " n"], offset: float
    ) -> _ShiftVotes:
        furthest = 1000  # cells in each direction, larger than any shift
        x, y, z = (np.floor(shifts / (2.0 * _CELL) + offset).astype(np.int64) + furthest).T
        keys = ((x * 2 * furthest + y) * 2 * furthest + z) * _NUM_POINTS + rows
        order = np.argsort(keys, kind="stable")
        return _ShiftVotes(order, *np.divmod(keys[order], _NUM_POINTS))

    def find_densest_cell(self, left: Bool[np.ndarray, " n"]) -> tuple[int, Int[np.ndarray, " k"]]:
        """Return the largest number of points voting for one cell, and the shifts in that cell.

        Only the shifts in `left` count. At least one must be left.
        """
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
    """Move all copies of a point onto one.

    The points are moved by whole multiples of the shortest shift into one period of it.
    """
    if len(shifts) == 0:
        return points_world
    shift = shifts[np.argmin(np.linalg.norm(shifts, axis=1))]
    along = points_world @ shift / (shift @ shift)
    fractions = np.sort(along % 1.0)
    # cut at the largest gap: copies on two sides of the cut would be a period apart
    gap = int(np.argmax(np.diff(fractions, append=fractions[:1] + 1.0))) if len(fractions) else 0
    cut = fractions[gap] + 1e-6 if len(fractions) else 0.0
    return points_world - np.floor(along - cut)[:, None] * shift
