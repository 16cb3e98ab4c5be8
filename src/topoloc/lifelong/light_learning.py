"""Choose the images of a session that can teach a map another light, and measure whether they do.

The map recognises little of an image in another light, although it knows the surfaces. Such images
become nodes, whose landmarks have the depths of the map (`session_content.py`) and the descriptors
of the new light. They stay only if the images recognise more of each other than of the map.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from itertools import pairwise

import numpy as np

from topoloc.geometry.rigid import Rigid3
from topoloc.lifelong.session_poses import SessionPoses
from topoloc.mapping.node_drafts import observe_node
from topoloc.mapping.nodes import find_nearest_nodes, node_distances
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.node_ids import Row


def find_poorly_recognised(topomap: TopoMetricMap, session_poses: SessionPoses) -> set[int]:
    """Return the queried frames with a pose that see surfaces of the map, of which the map
    recognises little."""
    min_inliers = 150  # an image with more is localized in all likelihood from beside it, too
    reach = 4.0  # to the nearest node by Eq. 1, in D_thresh: farther ones show other surfaces
    nodes, config = topomap.node_poses, topomap.config
    return {
        index
        for index, answer in session_poses.answers.items()
        if (pose := session_poses.world_from_cams.get(index)) is not None
        and (answer is None or answer.num_inliers < min_inliers)
        and node_distances(pose, nodes, config.lambda_rot).min() <= reach * config.d_thresh
    }


def select_learnable(
    poor: Set[int], motion: Sequence[Rigid3 | None], session_poses: SessionPoses, d_thresh: float
) -> set[int]:
    """Return the frames `poor` and the queried ones beside each, if their poses are certain: the
    map's answers agree with them. Without an answer, the session's own `motion` must agree with the
    answers from image to image. None is returned without one of `poor`."""
    max_error_m, num_sigmas = 0.1 * d_thresh, 3.0  # the answer's sigmas are added
    poses = session_poses.world_from_cams
    answers = {index: one for index, one in session_poses.answers.items() if one is not None}
    known = [(pose, answers[k].world_from_cam) for k in answers if (pose := motion[k]) is not None]
    errors_m = [
        np.linalg.norm((a.inverse() @ b).translation - (c.inverse() @ d).translation)
        for (a, c), (b, d) in pairwise(known)
    ]
    is_motion_good = bool(np.median(errors_m or [0.0]) <= max_error_m)

    def is_certain(index: int) -> bool:
        if (answer := answers.get(index)) is None:
            return is_motion_good
        tolerance_m = max_error_m + num_sigmas * answer.position_sigma_m
        return poses[index].is_same(answer.world_from_cam, tolerance_m, math.pi)

    queried = filter(poses.__contains__, session_poses.answers)
    beside = {one for pair in pairwise(queried) if not poor.isdisjoint(pair) for one in pair}
    certain = set(filter(is_certain, beside | poor))
    return certain if certain & poor else set()


def find_learned_images(
    changed: TopoMetricMap, num_old: int, indices: Mapping[str, int], poor: Set[int]
) -> tuple[set[int], dict[str, int]]:
    """Look in the images of new nodes (`indices`: their frames by name) for landmarks of the map
    that it was before (the first `num_old` nodes), and for landmarks of the other images.

    Return the frames that stay and the numbers of recognised landmarks by the names of the map's
    history. All stay or none, as the frames `poor` tell, but those that contradict their poses. Of
    the landmarks in view, they must show a larger share of each other's than of the map's: at its
    borders the map has few landmarks, but shows them as well as everywhere.
    """
    min_gain = 1.25  # images in the map's own light show less of each other than of the map
    min_recognised = 30  # landmarks that an image shows where its pose predicts them
    new = [row for row in changed.rows[num_old:] if changed.summaries[row].name in indices]
    by_map, by_others, learned = np.zeros(2, int), np.zeros(2, int), set[int]()
    for row in new:
        index, others = indices[changed.summaries[row].name], [one for one in new if one != row]
        of_map = _count_recognised(changed, row, changed.rows[:num_old])
        of_others = _count_recognised(changed, row, others)
        if max(of_map[0], of_others[0]) >= min_recognised:
            learned.add(index)
            if index in poor:
                by_map, by_others = by_map + of_map, by_others + of_others
    of_map, of_others = (seen / max(in_view, 1) for seen, in_view in (by_map, by_others))
    seen = {
        "landmarks_of_map_seen": int(by_map[0]),
        "landmarks_of_each_other_seen": int(by_others[0]),
    }
    return learned if of_others > min_gain * of_map else set(), seen


def _count_recognised(topomap: TopoMetricMap, row: Row, known: Sequence[Row]) -> tuple[int, int]:
    """Return how many landmarks the image of a node shows of one of the two nearest nodes among
    `known`, the better one, and how many of that are in view."""
    summary, image = topomap.summaries[row], topomap.first_layer.nodes[row].camera
    pose, poses = summary.world_from_cam, topomap.node_poses.rows(known)

    def count(other: Row) -> tuple[int, int]:
        cam_from_node = pose.inverse() @ topomap.summaries[other].world_from_cam
        num_seen, num_in_view = 0, 0
        for layer in topomap.layers.values():
            node, features = layer.nodes[other], layer.nodes[row].features
            num_seen += len(observe_node(node, features, image, cam_from_node).rows)
            points = cam_from_node.apply(node.points_cam.astype(np.float64))
            is_seen = (points[:, 2] > 0.0) & image.is_in_image(image.img_from_cam(points))
            num_in_view += int(np.count_nonzero(is_seen))
        return num_seen, num_in_view

    nearest = find_nearest_nodes(pose, poses, topomap.config.lambda_rot, 2) if known else []
    return max((count(known[k]) for k in nearest), default=(0, 0))
