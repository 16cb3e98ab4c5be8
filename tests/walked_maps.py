"""Make maps of walks along given lines: nodes with poses and edges of a build, without points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from hand_made import two_nodes
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.config import MapConfig
from topoloc.mapping.nodes import NodeConfig, NodePoses, find_nearest_nodes, select_node_frames
from topoloc.mapping.storage.entries import Edge, Layer, NodeSummary, Session
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.node_ids import NodeId

Corners = Sequence[tuple[float, float]]
D_THRESH = 0.5


def walk_along(corners: Corners, step: float = 0.1) -> list[Rigid3]:
    """Return world_from_cam (z up) of a camera that looks ahead, along lines on the ground."""
    poses = list[Rigid3]()
    for start, end in pairwise(np.array(corners, np.float64)):
        ahead = (end - start) / np.linalg.norm(end - start)
        z, down = np.array([*ahead, 0.0]), np.array([0.0, 0.0, -1.0])
        rotation = np.column_stack([np.cross(down, z), down, z])
        count = max(2, round(float(np.linalg.norm(end - start)) / step) + 1)
        for share in np.linspace(0.0, 1.0, count):
            poses.append(Rigid3(rotation, np.array([*((1 - share) * start + share * end), 1.4])))
    return poses


def map_of_walks(*walks: Sequence[Rigid3], d_thresh: float = D_THRESH) -> TopoMetricMap:
    """Return the map of these recordings, with the nodes and edges that a build gives it."""
    nodes = NodeConfig(d_thresh).resolved(1.0)
    assert nodes.lambda_rot is not None
    poses = [pose for walk in walks for pose in walk]
    frames = select_node_frames(poses, d_thresh, nodes.lambda_rot)
    stacked = NodePoses.from_poses([poses[frame] for frame in frames])
    session_of = np.repeat(np.arange(len(walks)), [len(walk) for walk in walks])
    summaries = [
        NodeSummary(
            NodeId(row), "walk", f"{frame}.png", int(frame), poses[frame], 0, int(session_of[frame])
        )
        for row, frame in enumerate(frames)
    ]
    edges = set[Edge]()
    for walk in walks:
        nearest = [find_nearest_nodes(pose, stacked, nodes.lambda_rot, 1)[0] for pose in walk]
        pairs = pairwise(NodeId(int(row)) for row in nearest)
        edges |= {Edge(*pair) for pair in pairs if pair[0] != pair[1]}
    made = two_nodes()
    template = made.nodes[0]
    return TopoMetricMap(
        summaries,
        {"surf": Layer([replace(template, summary=summary) for summary in summaries])},
        sorted(edges),
        [],
        replace(MapConfig(), nodes=nodes),
        1.0,
        sessions=[Session(number, f"walk{number}") for number in range(len(walks))],
    )
