"""Find the weak regions of a map from the map alone. Start reading at `find_weak_regions`.

A node is weak for one of four reasons. The rest of the map does not localize it
(`lifelong/node_localization.py`). It has few landmarks. No node near it looks in the opposite
direction. No other session saw it again or has a node beside it. Weak nodes near each other form a
region, which a new recording can visit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float

from topoloc import Localizer, Rigid3, TopoMetricMap
from topoloc.apps.core_names import (
    LeaveOneOutResult,
    NodeId,
    OneLine,
    Row,
    find_near_nodes,
    localize_left_out,
    sample_evenly,
)

Reason = Literal["not_held", "few_landmarks", "one_direction", "single_session"]
REASONS: tuple[Reason, ...] = get_args(Reason)
"""The reasons, the most severe first."""


@dataclass(frozen=True, repr=False)
class NodeQuality(OneLine):
    """Hold the quality of a node. `answer` is None if the node was not localized in the rest of the
    map. `seen_share` is the share of its landmarks that other sessions saw."""

    node_id: NodeId
    name: str
    session_id: int
    world_from_cam: Rigid3
    num_landmarks: int
    seen_share: float
    answer: LeaveOneOutResult | None
    reasons: tuple[Reason, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the node's quality as JSON."""
        answer = self.answer
        return {
            "node_id": self.node_id,
            "name": self.name,
            "session_id": self.session_id,
            "position": self.world_from_cam.translation.round(3).tolist(),
            "num_landmarks": self.num_landmarks,
            "seen_by_other_sessions": round(self.seen_share, 3),
            "without_itself": answer
            and {"localized": answer.is_localized, "inliers": answer.num_inliers},
            "weak": list(self.reasons),
        }


@dataclass(frozen=True, eq=False, repr=False)
class WeakRegion(OneLine):
    """Hold nodes near each other that are weak for the same reason, in the order of their ids."""

    reason: Reason
    nodes: list[NodeQuality]

    @property
    def centre(self) -> Float[np.ndarray, "3"]:
        """Return the position (metres, world) of the node nearest to the mean position. The mean
        itself may be off a bent trajectory."""
        positions = np.array([node.world_from_cam.translation for node in self.nodes])
        return positions[int(np.linalg.norm(positions - positions.mean(axis=0), axis=1).argmin())]

    def to_json(self) -> dict[str, Any]:
        """Return the region as JSON."""
        ids = [node.node_id for node in self.nodes]
        return {"reason": self.reason, "centre": self.centre.round(3).tolist(), "node_ids": ids}


@dataclass(frozen=True, eq=False, repr=False)
class WeakRegions(OneLine):
    """Hold the quality of every node, in the map's order, and the weak regions.

    Regions are sorted by reason, the most severe first, then by size, the largest first.
    """

    nodes: list[NodeQuality]
    parts: list[WeakRegion]
    session_names: dict[int, str]

    def count(self, reason: Reason) -> int:
        """Return the number of nodes that are weak for this reason."""
        return sum(reason in node.reasons for node in self.nodes)

    @property
    def weakest(self) -> list[NodeQuality]:
        """Return the queried nodes, the fewest inliers first."""
        return sorted(
            self.queried_nodes, key=lambda node: node.answer.num_inliers if node.answer else 0
        )

    @property
    def queried_nodes(self) -> list[NodeQuality]:
        """Return the nodes that were localized in the rest of the map, with or without success."""
        return [node for node in self.nodes if node.answer is not None]

    def to_json(self) -> dict[str, Any]:
        """Return all counts, regions and nodes as JSON."""
        return {
            "num_nodes": len(self.nodes),
            "num_sessions": len(self.session_names),
            "num_asked": len(self.queried_nodes),
            "num_localized": sum(
                bool(node.answer and node.answer.is_localized) for node in self.nodes
            ),
            "weak": {reason: self.count(reason) for reason in REASONS},
            "where_next": self.suggest_next_recording(),
            "parts": [part.to_json() for part in self.parts],
            "nodes": [node.to_json() for node in self.nodes],
        }

    def suggest_next_recording(self) -> str:
        """Suggest in one or two sentences the places of the next recording."""
        sentences, largest = list[str](), dict[Reason, WeakRegion]()
        for part in sorted(self.parts, key=lambda part: -len(part.nodes)):
            largest.setdefault(part.reason, part)
        poor = [largest[reason] for reason in ("not_held", "few_landmarks") if reason in largest]
        if poor:
            part = max(poor, key=lambda part: len(part.nodes))
            held = f"the rest of the map does not hold {'it' if len(part.nodes) == 1 else 'them'}"
            why = held if part.reason == "not_held" else "few landmarks are known there"
            sentences.append(f"Walk again past {self._describe_region(part)}: {why}.")
        if one_way := largest.get("one_direction"):
            num, of = self.count("one_direction"), len(self.nodes)
            past = f"the other way past {self._describe_region(one_way)}"
            where = "all of it the other way" if num == of else past
            sentences.append(f"Walk {where}: {num} of {of} nodes look where nobody looks back.")
        if len(self.session_names) < 2:
            sentences.append(
                "All of it is of one session: a walk on another day, or in another light, tells"
                " what lasts."
            )
        elif once := largest.get("single_session"):
            place = self._describe_region(once)
            sentences.append(f"Walk again past {place}: seen by one session alone.")
        return " ".join(sentences[:2]) or "No part is weak."

    def _describe_region(self, part: WeakRegion) -> str:
        first, last = part.nodes[0], part.nodes[-1]
        place = "({:.1f}, {:.1f}, {:.1f}) m".format(*(part.centre.round(1) + 0.0))  # no -0.0
        sessions = ", ".join(sorted({self.session_names[node.session_id] for node in part.nodes}))
        if first is last:
            return f"{place}, node {first.node_id} ({first.name} of {sessions})"
        names = f"{first.name} to {last.name}"
        return f"{place}, {len(part.nodes)} nodes ({names} of {sessions})"


def find_weak_regions(
    localizer: Localizer,
    progress: Callable[[str, int, int], None] | None = None,
    *,
    max_queries: int = 200,
    beside: float = 0.0,
    reach: float = 4.0,
    stood_by: float = 1.5,
) -> WeakRegions:
    """Assess each node of a map by the rest of the map.

    Args:
        max_queries: maximum number of nodes, evenly spaced, that are localized in the rest of the
            map.
        beside: nodes of the same session within this many D_thresh (Eq. 1) are hidden together with
            a node. Nodes of one session are more than one D_thresh apart, so 0 hides only the node
            itself.
        reach: maximum distance of a node with the opposite view, in D_thresh.
        stood_by: maximum distance of another session's node beside a node, in D_thresh (Eq. 1).

    Raises:
        MapError: the map cannot be read.
    """
    min_turn_deg = 120.0  # minimum angle between opposite views, in degrees
    apart = 3.0  # weak nodes within this many D_thresh of each other form one region
    topomap = localizer.topomap
    rows = sample_evenly(topomap.rows, max_queries)
    report = None if progress is None else partial(progress, "asking the map without the node")
    answers = localize_left_out(localizer, topomap, rows, beside, report)
    d_thresh = topomap.config.d_thresh
    opposite = reach * d_thresh, np.cos(np.deg2rad(min_turn_deg))
    nodes = [
        _assess_node(topomap, row, answers.get(row), opposite, stood_by) for row in topomap.rows
    ]
    parts = list[WeakRegion]()
    for reason in REASONS:
        weak = [node for node in nodes if reason in node.reasons]
        of_reason = [WeakRegion(reason, one) for one in _cluster_nodes(weak, apart * d_thresh)]
        parts += sorted(of_reason, key=lambda part: -len(part.nodes))
    names = {summary.session_id: summary.recording for summary in topomap.summaries}
    names |= {session.session_id: session.name for session in topomap.sessions}
    return WeakRegions(nodes, parts, names)


def _assess_node(
    topomap: TopoMetricMap,
    row: Row,
    answer: LeaveOneOutResult | None,
    opposite: tuple[float, float],
    stood_by: float,
) -> NodeQuality:
    # The rest of the map must localize a node with at least this many inliers. An update adds
    # no node for such an image.
    min_inliers = 60
    min_landmarks = 100  # A node with fewer landmarks than this is weak
    # A node is weak if other sessions saw less than this share of its landmarks and none has
    # a node beside it.
    min_seen_share = 0.2
    node, summary = topomap.nodes[row], topomap.summaries[row]
    seen, reasons = np.zeros(len(node.features), bool), list[Reason]()  # by other sessions
    for one in node.session_statistics:
        if one.session_id != summary.session_id:
            seen[one.rows[one.seen > 0]] = True
    seen_share = float(seen.mean()) if len(seen) else 0.0
    if answer is not None and answer.num_inliers < min_inliers:
        reasons.append("not_held")
    if summary.num_points < min_landmarks:
        reasons.append("few_landmarks")
    if not topomap.node_poses.has_opposite(row, *opposite):
        reasons.append("one_direction")
    beside = (topomap.summaries[k].session_id for k in find_near_nodes(topomap, row, stood_by))
    if seen_share < min_seen_share and all(one == summary.session_id for one in beside):
        reasons.append("single_session")
    return NodeQuality(
        summary.node_id,
        summary.name,
        summary.session_id,
        summary.world_from_cam,
        summary.num_points,
        seen_share,
        answer,
        tuple(reasons),
    )


def _cluster_nodes(nodes: Sequence[NodeQuality], apart_m: float) -> list[list[NodeQuality]]:
    """Cluster nodes that are connected by steps of at most `apart_m` (metres)."""
    positions = np.array([node.world_from_cam.translation for node in nodes]).reshape(-1, 3)
    left, groups = np.ones(len(nodes), bool), list[list[NodeQuality]]()
    while left.any():
        waiting, group = [int(np.flatnonzero(left)[0])], list[int]()
        left[waiting[0]] = False
        while waiting:
            group.append(waiting.pop())
            near = np.flatnonzero(
                left & (np.linalg.norm(positions - positions[group[-1]], axis=1) <= apart_m)
            ).tolist()
            left[near] = False
            waiting += near
        groups.append([nodes[k] for k in sorted(group)])
    return groups
