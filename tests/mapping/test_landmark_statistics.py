"""Test the sums of sessions: they give positions and covariances, and one session can
be subtracted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import topoloc
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.landmark_statistics import (
    PULL_SCALE,
    LandmarkStatistics,
    merge_count_statistics,
)
from topoloc.mapping.landmarks import Observations, compute_session_statistics, refine_points
from topoloc.mapping.storage.entries import TopoNode
from topoloc.mapping.topomap import TopoMetricMap


@dataclass(frozen=True, eq=False)
class Sums:
    """Hold the sums of all points of a node over some sessions. The value -1 means no session."""

    information: np.ndarray
    pulls: np.ndarray
    expected: np.ndarray
    seen: np.ndarray
    first_session: np.ndarray
    last_session: np.ndarray

    @staticmethod
    def of(statistics: Sequence[LandmarkStatistics], num_points: int) -> Sums:
        """Add up the statistics as the documentation of the file defines them (A = L L', g = L
        times the pulls)."""
        information, pulls = np.zeros((num_points, 3, 3)), np.zeros((num_points, 3))
        expected, seen = np.zeros(num_points, np.int64), np.zeros(num_points, np.int64)
        first, last = np.full(num_points, -1), np.full(num_points, -1)
        for part in sorted(statistics, key=lambda part: part.session_id):
            lower = np.zeros((len(part.rows), 3, 3))
            lower[:, *np.tril_indices(3)] = part.roots
            information[part.rows] += lower @ lower.transpose(0, 2, 1)
            pulls[part.rows] += (lower @ (part.pulls / PULL_SCALE)[:, :, None])[:, :, 0]
            expected[part.rows] += part.expected
            seen[part.rows] += part.seen
            saw = part.rows[part.seen > 0]
            last[saw] = part.session_id
            first[saw] = np.where(first[saw] < 0, part.session_id, first[saw])
        return Sums(information, pulls, expected, seen, first, last)

    def solve(self, points_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and covariances from these sums, for points stored at `points_cam`."""
        covariances = np.linalg.inv(self.information)
        return points_cam - (covariances @ self.pulls[:, :, None])[:, :, 0], covariances


def covariances_of(node: TopoNode) -> np.ndarray:
    lower = np.zeros((len(node.points_cam), 3, 3))
    lower[:, *np.tril_indices(3)] = node.point_sqrt_covs
    return lower @ lower.transpose(0, 2, 1)


def test_positions_and_covariances_of_a_saved_map_follow_from_its_sums(saved: Path):
    topomap = TopoMetricMap.load(saved)
    for node in topomap.nodes:
        total = Sums.of(list(node.session_statistics), len(node.features))
        points, covariances = total.solve(node.points_cam.astype(np.float64))
        known = covariances_of(node)
        sigmas = np.sqrt(np.einsum("nii->ni", known))
        assert (np.abs(points - node.points_cam) < 0.01 * sigmas + 1e-6).all()
        assert (
            np.abs(covariances - known) / (sigmas[:, :, None] * sigmas[:, None, :])
        ).max() < 0.02
        assert (total.seen >= 1).all()
        assert (total.expected >= total.seen).all()
        assert (total.seen > 1).mean() > 0.3
        assert (total.first_session == 0).all()


def test_the_sums_cost_little(saved: Path):
    topomap = TopoMetricMap.load(saved)
    assert topomap.file is not None
    with topomap.file.read_connection() as database:
        num_bytes, num_points = database.execute(
            "SELECT sum(length(sums)), sum(num_rows) FROM landmark_sums"
        ).fetchone()
    assert num_bytes / num_points < 25


def test_a_session_can_be_taken_away_again():
    """Points of one session were observed by another. Without its sums they return to their
    old positions."""
    rng = np.random.default_rng(0)
    truth = np.column_stack([rng.uniform(-1.0, 1.0, (40, 2)), rng.uniform(2.0, 4.0, 40)])
    covariances = np.tile(np.diag([1e-4, 1e-4, 1e-2]), (40, 1, 1))
    measured = truth + rng.normal(0.0, 1.0, (40, 3)) * np.array([0.01, 0.01, 0.1])

    def observed(shift: float, session_id: int) -> Observations:
        cam_from_node = Rigid3(np.eye(3), np.array([shift, 0.0, 0.0]))
        points = cam_from_node.apply(truth)
        normalized = points[:, :2] / points[:, 2:] + rng.normal(0.0, 1e-3, (40, 2))
        return Observations(
            np.arange(40), normalized, np.full(40, 1e-3), cam_from_node, np.arange(40), session_id
        )

    first, second = [observed(-0.3, 0), observed(0.2, 0)], [observed(0.5, 7), observed(-0.6, 7)]
    alone, both = (
        refine_points(measured, covariances, seen, num_iterations=20)
        for seen in (first, [*first, *second])
    )
    session_statistics = compute_session_statistics(
        both.points_cam, measured, covariances, [*first, *second], np.arange(40), node_session_id=0
    )
    assert [of_session.session_id for of_session in session_statistics] == [0, 7]
    assert [(of_session.expected[0], of_session.seen[0]) for of_session in session_statistics] == [
        (3, 3),
        (2, 2),
    ]
    together = Sums.of(session_statistics, 40)
    np.testing.assert_array_equal(together.first_session, 0)
    np.testing.assert_array_equal(together.last_session, 7)
    back, covariance = Sums.of(session_statistics[:1], 40).solve(both.points_cam)
    moved = np.linalg.norm(both.points_cam - alone.points_cam, axis=1)
    assert np.median(np.linalg.norm(back - alone.points_cam, axis=1)) < 0.15 * np.median(moved)
    assert (
        np.median(
            np.abs(covariance - alone.covariances)
            / np.abs(alone.covariances).max(axis=(1, 2), keepdims=True)
        )
        < 0.05
    )


def test_every_node_of_a_map_has_sums_of_its_session(tiny_recording: Path):
    topomap = topoloc.build_map(topoloc.open_sequence(f"{tiny_recording}@0:6"))
    for node in topomap.nodes:
        (session_statistics,) = node.session_statistics
        np.testing.assert_array_equal(session_statistics.rows, np.arange(len(node.features)))


def _counts(session_id: int, rows: list[int], expected: int, seen: list[int]) -> LandmarkStatistics:
    num = len(rows)
    return LandmarkStatistics.from_equations(
        session_id,
        np.array(rows),
        np.zeros((num, 3, 3)),
        np.zeros((num, 3)),
        np.full(num, expected),
        np.array(seen),
    )


def test_sessions_that_only_counted_take_the_room_of_two():
    """Sessions in other light, with few observations, stay separate from sessions with many."""
    own = LandmarkStatistics.from_equations(
        0,
        np.arange(3),
        np.tile(np.eye(3), (3, 1, 1)),
        np.full((3, 3), 0.1),
        np.ones(3, int),
        np.ones(3, int),
    )
    session_statistics = [
        own,
        _counts(1, [0, 1], 4, [4, 2]),
        _counts(2, [0, 2], 5, [0, 0]),
        _counts(3, [1, 2], 3, [3, 1]),
        _counts(4, [2], 2, [0]),
    ]
    together = merge_count_statistics(session_statistics)
    assert [part.session_id for part in together] == [0, 3, 4]
    assert together[0] is own
    assert together[1].rows.tolist() == [0, 1, 2]
    assert together[1].expected.tolist() == [4, 7, 3]
    assert together[1].seen.tolist() == [4, 5, 1]
    assert together[2].expected.tolist() == [5, 7]
    before, after = (
        Sums.of(session_statistics, 3),
        Sums.of(together, 3),
    )
    np.testing.assert_array_equal(before.expected, after.expected)
    np.testing.assert_array_equal(before.seen, after.seen)
    np.testing.assert_allclose(before.information, after.information, atol=1e-5)
