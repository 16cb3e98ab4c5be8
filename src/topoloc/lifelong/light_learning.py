"""Decide which images of a session teach a map another light, and whether they do."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from topoloc.lifelong.session_poses import SessionPoses
from topoloc.mapping.node_drafts import observe_node
from topoloc.mapping.nodes import find_nearest_nodes
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.node_ids import Row


def find_learnable_frames(
    topomap: TopoMetricMap, session_poses: SessionPoses, min_inliers: int = 150
) -> set[int]:
    """Return the queried frames with a pose that look at mapped surfaces, but of which the map
    recognises fewer than `min_inliers` landmarks."""
    reach, max_turn_deg = 4.0, 30.0  # of the nearest node: D_thresh, and degrees
    found = set[int]()
    for index, answer in session_poses.answers.items():
        pose = session_poses.world_from_cams.get(index)
        if pose is not None and (answer is None or answer.num_inliers < min_inliers):
            nodes = topomap.node_poses
            metres = np.linalg.norm(nodes.centres - pose.translation, axis=1)
            along = nodes.rotations[:, :, 2] @ pose.rotation[:, 2]
            near = metres <= reach * topomap.config.d_thresh
            if (near & (along > math.cos(math.radians(max_turn_deg)))).any():
                found.add(index)
    return found


def measure_learning(changed: TopoMetricMap, num_old: int) -> dict[str, Any]:
    """Look for the landmarks that the map had (its first `num_old` nodes), and for those that it
    learned, in each new node's image. Its own landmarks are left out: the neighbours' are looked
    for. Return the counts by the names of the history, and whether the map `learned`: more of the
    new ones are recognised."""
    min_gain = 1.1
    rows, num = changed.rows[num_old:], [0, 0]
    reach = 8.0 * changed.config.d_thresh
    asked = 0
    for row in rows:
        others = [k for k in rows if k != row]
        pose = changed.summaries[row].world_from_cam
        others = [
            k
            for k in others
            if np.linalg.norm(changed.summaries[k].world_from_cam.translation - pose.translation)
            <= reach
        ]
        if others:
            asked += 1
            counts = [_count_recognised(changed, row, group) for group in (changed.rows[:num_old], others)]
            print(row, counts)
            num = [a + b for a, b in zip(num, counts, strict=True)]
    return {
        "learned": num[1] > min_gain * num[0],
        "left_out_asked": asked,
        "left_out_recognised_before": num[0],
        "left_out_recognised_after": num[1],
    }


def _count_recognised(topomap: TopoMetricMap, row: Row, known: Sequence[Row]) -> int:
    """Return how many landmarks of the best of the two nearest nodes among `known` are recognised
    in the image of a node, at its pose."""
    config, pose = topomap.config, topomap.summaries[row].world_from_cam
    poses = topomap.node_poses.rows(known)
    nearest = find_nearest_nodes(pose, poses, config.lambda_rot, 2)
    counts = [0]
    for one in (known[k] for k in nearest):
        cam_from_node = pose.inverse() @ topomap.summaries[one].world_from_cam
        counts.append(
            sum(
                len(
                    observe_node(
                        layer.nodes[one],
                        layer.nodes[row].features,
                        layer.nodes[row].camera,
                        cam_from_node,
                    ).rows
                )
                for layer in topomap.layers.values()
            )
        )
    return max(counts)
