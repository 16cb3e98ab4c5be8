"""What would be seen from where a node stands: first poses for pictures whose features are hard to match.

In the dark, most true matches fail the ratio test: among thousands of descriptors something is always as similar. A camera near a node
sees the same things about where the node saw them, about as large and as upright, and among the few key points that fit so the
most similar one is right far more often. So each node that the coarse localizer ranks high lends its pose as if it were the camera's: its
points are sought widely around where it saw them, and the pose that most of these matches agree on is a first pose like any other.
That a picture was compared so is no evidence for the pose; it is judged by matches that nothing guided (`verification.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from topoloc.bounds import Between
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.attempt import Attempt
from topoloc.localization.guided import GuidedConfig
from topoloc.map.nodes import NodePoses, node_distances


@dataclass(frozen=True)
class StandpointsConfig:
    """Where a picture that is not clear is compared with what nodes saw."""

    num_nodes: Annotated[int, Between(0, 10_000)] = 24
    """Nodes of the best coarse rank that are tried, one by one; 0 tries none."""
    max_poses: Annotated[int, Between(0, 1000)] = 6
    """Of the poses found, those with the most inliers are looked into."""
    max_iterations: Annotated[int, Between(1, 1_000_000)] = 500
    """Of RANSAC, for each of them."""
    matching: GuidedConfig = field(
        default_factory=lambda: GuidedConfig(radius_px=64.0, max_scale=1.5, max_turn=0.35, min_similarity=0.8, min_margin=0.02)
    )


def strongest_and_distinct(attempts: list[Attempt], lambda_rot: float, max_distance: float, max_poses: int) -> list[Attempt]:
    """Of attempts that have a pose those with the most inliers, no two of them within `max_distance` (Eq. 1, metres) of each other."""
    kept: list[Attempt] = []
    poses: list[Rigid3] = []
    for attempt in sorted(attempts, key=lambda attempt: -attempt.num_inliers):
        if attempt.pose is None or len(kept) == max_poses:
            continue
        world_from_cam = attempt.pose.cam_from_world.inverse()
        if not poses or node_distances(world_from_cam, NodePoses.of(poses), lambda_rot).min() > max_distance:
            kept.append(attempt)
            poses.append(world_from_cam)
    return kept
