"""Test pose graphs with closed loops, and one with a wrong loop."""

from __future__ import annotations

import numpy as np

from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.slam.pose_graph import (
    PoseGraphEdge,
    compute_normalized_residuals,
    optimize_pose_graph,
)

NUM = 40
COVARIANCE = np.diag([1e-4] * 3 + [1e-5] * 3)


def ring() -> tuple[list[Rigid3], list[Rigid3], list[PoseGraphEdge]]:
    """Return cam_from_world of a round walk, true and with drift, and its motion edges."""
    step = Rigid3(exp_so3(np.array([0.0, 2 * np.pi / NUM, 0.0])), np.array([0.0, 0.0, -0.5]))
    drift = Rigid3.exp(np.array([0.004, 0.0, 0.006, 0.0, 0.004, 0.0]))
    true, drifted, edges = [Rigid3.identity()], [Rigid3.identity()], []
    for k in range(1, NUM):
        true.append(step @ true[-1])
        drifted.append(drift @ step @ drifted[-1])
        edges.append(PoseGraphEdge(k - 1, k, drift @ step, COVARIANCE, is_loop=False))
    return true, drifted, edges


def loop(true: list[Rigid3], first: int, second: int) -> PoseGraphEdge:
    return PoseGraphEdge(
        first, second, true[second] @ true[first].inverse(), COVARIANCE, is_loop=True
    )


def errors(poses: list[Rigid3], true: list[Rigid3]) -> np.ndarray:
    return np.array(
        [
            np.linalg.norm(p.inverse().translation - t.inverse().translation)
            for p, t in zip(poses, true, strict=True)
        ]
    )


def test_a_loop_takes_most_of_the_drift_away():
    true, drifted, edges = ring()
    loops = [loop(true, 0, NUM - 1), loop(true, 2, NUM - 3)]
    poses = optimize_pose_graph(drifted, edges + loops)
    np.testing.assert_allclose(poses[0].matrix(), np.eye(4), atol=1e-9)
    assert errors(poses, true).max() < 0.35 * errors(drifted, true).max()
    assert compute_normalized_residuals(poses, loops).max() < 3.0


def test_a_wrong_loop_is_outvoted_and_stands_out():
    true, drifted, edges = ring()
    right = [loop(true, i, NUM - 1 - i) for i in range(4)]
    wrong = PoseGraphEdge(
        5, 25, Rigid3(np.eye(3), np.array([0.3, 0.0, 0.2])), COVARIANCE, is_loop=True
    )
    with_wrong = optimize_pose_graph(drifted, [*edges, *right, wrong])
    without = optimize_pose_graph(drifted, edges + right)
    assert errors(with_wrong, without).max() < 0.1
    lengths = compute_normalized_residuals(with_wrong, [*right, wrong])
    assert lengths[-1] > 8.0 > lengths[:-1].max()
