"""First poses from walls seen from the other side: where might a side view have been taken?

A side view and a side node show the same wall without slant, so that one is the other, moved and scaled. Every single match of key points,
with their sizes and orientations, says how (as in Lowe, 2004, section 7.4); the one that most of the matches agree with gives the pose.
PnP on these matches does not: the points lie in one plane, and a plane has a second pose that looks nearly the same from the other slant.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from topoloc.features.features import Features, Matches
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.map.topomap import TopoNode

_LARGEST_TURN, _LARGEST_SCALE = 0.5, 4.0
_TOLERANCE, _TOLERANCE_SHARE, _TOLERANCE_LOG_SCALE = 0.05, 0.15, 0.5


def agreeing_pose(features: Features, camera: Camera, node: TopoNode, matches: Matches) -> tuple[int, Rigid3] | None:
    """How many matches of a side view's features with a side node's agree on one similarity, and the side_from_world that follows.

    Similarities that turn by more than 0.5 rad or scale by more than 4 are not considered. None with fewer than three matches that agree.
    """
    seen, kept = features.select(matches.query_idx), node.features.select(matches.train_idx)
    to, since = camera.normalized_from_img(seen.points_img), node.camera.normalized_from_img(kept.points_img)
    turns = np.angle(np.exp(1j * (seen.angles.astype(np.float64) - kept.angles)))
    scales = seen.sizes_px.astype(np.float64) / camera.fx / (kept.sizes_px / node.camera.fx)
    plausible = (np.abs(turns) < _LARGEST_TURN) & (np.abs(np.log(scales)) < np.log(_LARGEST_SCALE))
    agreeing = _largest_consensus(to, since, turns, scales, plausible)
    if np.count_nonzero(agreeing) < 3:
        return None
    points_node = node.points_cam[matches.train_idx[agreeing]].astype(np.float64)
    side_from_node = _pose_of_similarity(to[agreeing], since[agreeing], float(np.median(turns[agreeing])), points_node)
    if side_from_node is None:
        return None
    return int(np.count_nonzero(agreeing)), side_from_node @ node.summary.world_from_cam.inverse()


def _largest_consensus(
    to: Float[np.ndarray, "n 2"],
    since: Float[np.ndarray, "n 2"],
    turns: Float[np.ndarray, " n"],
    scales: Float[np.ndarray, " n"],
    plausible: np.ndarray,
) -> np.ndarray:
    """The plausible matches that agree with the one that most agree with; row k of the tables below is what match k says of all."""
    cosines, sines = scales * np.cos(turns), scales * np.sin(turns)
    dx, dy = (since[None, :, axis] - since[:, None, axis] for axis in (0, 1))
    moved_x = cosines[:, None] * dx - sines[:, None] * dy
    moved_y = sines[:, None] * dx + cosines[:, None] * dy
    seen_x, seen_y = (to[None, :, axis] - to[:, None, axis] for axis in (0, 1))
    misses = np.hypot(seen_x - moved_x, seen_y - moved_y)
    agree = misses < _TOLERANCE + _TOLERANCE_SHARE * np.hypot(seen_x, seen_y)
    agree &= np.abs(np.log(scales)[None, :] - np.log(scales)[:, None]) < _TOLERANCE_LOG_SCALE
    agree &= plausible[None, :] & plausible[:, None]
    return agree[np.argmax(agree.sum(axis=1))] if len(agree) else plausible


def _pose_of_similarity(
    to: Float[np.ndarray, "n 2"], since: Float[np.ndarray, "n 2"], turn: float, points_node: Float[np.ndarray, "n 3"]
) -> Rigid3 | None:
    """side_from_node, both cameras before the same wall: the scale says how much farther it is, the shift how far along."""
    spread = np.sum((since - np.median(since, axis=0)) ** 2)
    if spread < 1e-8:
        return None
    scale = float(np.sqrt(np.sum((to - np.median(to, axis=0)) ** 2) / spread))
    depth = float(np.median(points_node[:, 2])) / max(scale, 1e-3)
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    points_side = depth * np.column_stack([to, np.ones(len(to))])
    return Rigid3(rotation, np.median(points_side - points_node @ rotation.T, axis=0))
