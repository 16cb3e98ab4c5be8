"""Find nodes whose recorded poses contradict their neighbours.

Neighbouring nodes see the same points. Each node is localized with the points of one neighbour at a
time, without a prior. The result is compared with the recorded pose. Nodes that agree form a group.
A group that agrees within itself but not with the rest was moved. The data cannot show which of two
groups is in place, so the larger one is assumed to be.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from topoloc.features.features import MatchingConfig
from topoloc.features.matching import match_features
from topoloc.geometry.absolute_pose import AbsolutePoseConfig, estimate_absolute_pose
from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.localization.fitted_weights import load_fitted_weights
from topoloc.localization.pose_fit import LocalMap
from topoloc.mapping.nodes import node_distances
from topoloc.mapping.storage.entries import TopoNode
from topoloc.mapping.storage.integrity_check import find_map_damage
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.node_ids import NodeId


@dataclass(frozen=True)
class Contradiction:
    """Report that node `node_id` is `metres` and `degrees` off the pose found with node
    `other_id`."""

    node_id: NodeId
    other_id: NodeId
    metres: float
    degrees: float

    def __str__(self) -> str:
        apart = f"{self.metres:.2f} m and {self.degrees:.1f} degrees"
        return (
            f"node {self.node_id} contradicts node {self.other_id}: {apart} from where that one's"
            " points see it"
        )


def check_map(path: str | Path) -> list[str]:
    """Check every byte of a map file and, if these are intact, whether its nodes agree with their
    neighbours.

    Returns:
        One line for each problem; nothing if the map is intact.

    Raises:
        MapError: the map cannot be opened.
    """
    found = find_map_damage(Path(path))
    if found:
        return found
    with TopoMetricMap.load(path) as topomap:
        return [str(contradiction) for contradiction in find_contradictions(topomap)]


def find_contradictions(topomap: TopoMetricMap) -> list[Contradiction]:
    """Return one contradiction for each node outside the largest consistent part of the map.

    Raises:
        MapError: the map cannot be read.
    """
    num_neighbours = 4  # nearest nodes (Eq. 1) that each node is compared with
    # Minimum pose difference of a contradiction, in D_thresh (Eq. 1). It must also exceed the
    # covariance.
    min_distance = 0.5
    # Smaller differences are inaccuracy: poses of 7-Scenes have 0.05 m and 2 degrees.
    min_metres, min_radians = 0.1, math.radians(4.0)
    poses, lambda_rot = topomap.node_poses, topomap.config.lambda_rot
    errors = topomap.first_layer.shared_errors
    rho = load_fitted_weights(topomap.kind).shared_errors.unknown if errors is None else errors.rho
    group, found = list(range(len(topomap.summaries))), []
    for row, summary in enumerate(topomap.summaries):
        order = np.argsort(node_distances(summary.world_from_cam, poses, lambda_rot), kind="stable")
        neighbours = [int(k) for k in order if k != row][:num_neighbours]
        neighbours += [k for k in (row - 1, row + 1) if 0 <= k < len(group) and k not in neighbours]
        for other_row in neighbours:
            if group[row] == group[other_row]:
                continue  # contradictions within a group do not count
            difference = _pose_difference(topomap.nodes[row], topomap.nodes[other_row], rho)
            if difference is None:
                continue
            is_same, metres, radians = difference
            is_far = metres + lambda_rot * radians > min_distance * topomap.config.d_thresh
            is_large = metres > min_metres or radians > min_radians
            if is_far and is_large and not is_same:
                found.append((row, other_row, metres, radians))
            else:
                low, high = sorted((group[row], group[other_row]))
                group = [low if number == high else number for number in group]
    return _outside_largest_group(topomap, group, found)


def _pose_difference(
    node: TopoNode, other: TopoNode, rho: float
) -> tuple[bool, float, float] | None:
    """Compare a node's pose with the one found with the points of another node.

    Return whether the covariance allows the difference, and the metres and radians. None if they
    have too few points in common.
    """
    min_inliers = 30  # minimum number of common points
    max_square = 60.0  # of a difference in units of its covariance (6 degrees of freedom)
    points = LocalMap.of_node(other)
    matches = match_features(node.features.descriptors, points.descriptors, MatchingConfig())
    if len(matches) < min_inliers:
        return None
    found = estimate_absolute_pose(
        node.features.points_img[matches.query_idx].astype(np.float64),
        points.points_world[matches.train_idx],
        node.camera,
        AbsolutePoseConfig(max_reprojection_error_px=8.0),
        point_covariances=points.covariances[matches.train_idx],
    )
    if found is None or np.count_nonzero(found.inliers) < min_inliers:
        return None
    poses = found.cam_from_world.inverse(), node.summary.world_from_cam
    covariance = (1.0 + np.count_nonzero(found.inliers) * rho) * found.covariance
    is_same = poses[0].is_same(poses[1], covariance=covariance, max_square=max_square)
    return is_same, translation_error(*poses), rotation_error(*poses)


def _outside_largest_group(
    topomap: TopoMetricMap, group: list[int], found: list[tuple[int, int, float, float]]
) -> list[Contradiction]:
    """Return the contradictions between groups.

    Each is assigned to the node in the smaller group, and to the other nodes of that group.
    """
    sizes, worst = Counter(group), {}
    for row, other_row, metres, radians in found:
        if group[row] == group[other_row]:
            continue
        one, other = (
            (row, other_row) if sizes[group[row]] <= sizes[group[other_row]] else (other_row, row)
        )
        if one not in worst or metres > worst[one][1]:
            worst[one] = (other, metres, radians)
    moved = {group[one]: one for one in worst}
    ids = [summary.node_id for summary in topomap.summaries]
    for row, number in enumerate(group):  # the rest of a group that was moved as one
        if row not in worst and number in moved:
            worst[row] = worst[moved[number]]
    return [
        Contradiction(ids[row], ids[k], metres, float(np.degrees(radians)))
        for row, (k, metres, radians) in sorted(worst.items())
    ]
