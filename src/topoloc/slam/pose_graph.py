"""Optimise a pose graph: key frames are nodes, motions and loops are edges.

It uses Gauss-Newton with Cauchy's loss on the loops. An edge (i, j) measures Z = j_from_i. Its
residual is ``log(X_j X_i^-1 Z^-1)`` with X = cam_from_world, updated by left perturbations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from topoloc.geometry.rigid import Rigid3
from topoloc.slam.bundle.block_system import BlockPattern, solve_blocks


@dataclass(frozen=True, eq=False)
class PoseGraphEdge:
    """Hold second_from_first and the covariance of its left perturbation.

    A loop may be wrong and has a robust loss. A motion is always right.
    """

    first: int
    second: int
    second_from_first: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    is_loop: bool


def optimize_pose_graph(
    cam_from_worlds: Sequence[Rigid3],
    edges: Sequence[PoseGraphEdge],
    max_steps: int = 15,
    min_step: float = 1e-5,
) -> list[Rigid3]:
    """Return the optimised poses. The first one stays fixed.

    Args:
        max_steps: maximum number of steps.
        min_step: the optimisation ends at a step smaller than this, metres and radians.
    """
    # Scale of Cauchy's loss on loops, in sigma. Larger residuals have less and less weight.
    cauchy_scale, poses = 3.0, list(cam_from_worlds)
    informations = [np.linalg.inv(edge.covariance) for edge in edges]
    pattern = BlockPattern.from_pairs(len(poses), [(edge.first, edge.second) for edge in edges])
    places = [pattern.block_idx(edge.first, edge.second) for edge in edges]
    elimination_idx = pattern.elimination_idx
    for _ in range(max_steps):
        blocks, right = pattern.empty(), np.zeros((len(poses), 6))
        blocks[pattern.diagonal] = 1e-6 * np.eye(6)
        blocks[pattern.diagonal[elimination_idx[0]]] += 1e12 * np.eye(6)
        for edge, information, (block_idx, is_first_above) in zip(
            edges, informations, places, strict=True
        ):
            predicted = poses[edge.second] @ poses[edge.first].inverse()
            residual = (predicted @ edge.second_from_first.inverse()).log()
            if edge.is_loop:
                information = information / (
                    1.0 + residual @ information @ residual / cauchy_scale**2
                )
            adjoint = predicted.adjoint()
            weighted = adjoint.T @ information
            blocks[pattern.diagonal[elimination_idx[edge.second]]] += information
            blocks[pattern.diagonal[elimination_idx[edge.first]]] += weighted @ adjoint
            blocks[block_idx] -= weighted.T if is_first_above else weighted
            right[elimination_idx[edge.second]] -= information @ residual
            right[elimination_idx[edge.first]] += weighted @ residual
        steps = solve_blocks(pattern, blocks, right[None])[0][elimination_idx]
        poses = [Rigid3.exp(step) @ pose for step, pose in zip(steps, poses, strict=True)]
        if np.abs(steps).max() < min_step:
            break
    return poses


def compute_normalized_residuals(
    poses: Sequence[Rigid3], edges: Sequence[PoseGraphEdge]
) -> Float[np.ndarray, " e"]:
    """Return the length of each edge's residual, in standard deviations."""
    squares = [
        (poses[edge.first] @ poses[edge.second].inverse()).squared_distance(
            edge.second_from_first.inverse(), edge.covariance
        )
        for edge in edges
    ]
    return np.sqrt(squares)
