"""Side nodes: what the mapping cameras saw of the walls along their way, for those who come the
other way.

A node's points are known from where the mapping camera looked, and found again from there. Its
picture also holds the walls to the left and to the right, slanted; `features/side_views.py` shows
them as from before them. Some of the nodes are therefore described once more as two cameras in the
same place that look to the sides, with features and points of their own. They are no nodes of Eq.
1: the localizer asks them only where nothing else gave a pose (`localization/walls/`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float, Float32

from topoloc.bounds import AtLeast, Between
from topoloc.features.extraction import FeatureConfig, extract_features
from topoloc.features.side_views import SideView, SideViewConfig, side_views
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.entries import NodeSummary, SideNodes, TopoNode
from topoloc.mapping.nodes import NodeConfig, place_nodes
from topoloc.points.metric_points import MetricPointsConfig, locate_points
from topoloc.recordings.frame_view import FrameView
from topoloc.retrieval.vlad import SurfVlad, VladConfig, learn_words_of, placed, vlad
from topoloc.shelf import Shelf


@dataclass(frozen=True)
class SideNodesConfig:
    """Which nodes have side nodes, and what these keep."""

    spacing: Annotated[float, AtLeast(0)] = 3.0
    """Eq. 1 with so many times the map's D_thresh chooses among the nodes, a turn counting half; 0
    makes no side nodes."""
    opposite: Annotated[float, AtLeast(0)] = 10.0
    """Nodes that have another one looking the other way within so many D_thresh need no side
    nodes."""
    views: SideViewConfig = field(default_factory=SideViewConfig)
    max_points: Annotated[int, Between(1, 100_000)] = 400
    """Features that a side node keeps, the strongest ones."""
    min_points: Annotated[int, Between(1, 100_000)] = 20
    """With fewer a side view becomes no side node."""
    vlad: VladConfig = field(default_factory=lambda: VladConfig(position_weight=0.0))
    """Where on a wall things are seen depends on where the camera stands, so places in the picture
    do not count."""


def nodes_with_sides(
    world_from_nodes: list[Rigid3], node_config: NodeConfig, config: SideNodesConfig
) -> set[int]:
    """Which of the nodes with these poses are seen to the sides, too. `node_config` (of the map)
    must be resolved."""
    if config.spacing == 0.0:
        return set()
    assert node_config.d_thresh is not None, "resolve the configuration first"
    assert node_config.lambda_rot is not None, "resolve the configuration first"
    reach = config.opposite * node_config.d_thresh
    spaced = NodeConfig(config.spacing * node_config.d_thresh, node_config.lambda_rot / 2.0)
    centres = np.array([pose.translation for pose in world_from_nodes])
    axes = np.array([pose.rotation[:, 2] for pose in world_from_nodes])

    def is_seen_back(k: int) -> bool:
        near = np.linalg.norm(centres - centres[k], axis=1) < reach
        return bool((near & (axes @ axes[k] < -0.7)).any())

    return {int(k) for k in place_nodes(world_from_nodes, spaced) if not is_seen_back(int(k))}


def describe_sides(
    of_node: NodeSummary,
    view: FrameView,
    features: FeatureConfig,
    points: MetricPointsConfig,
    config: SideNodesConfig,
) -> list[TopoNode]:
    """The side nodes of a node's picture, none to two of them, not numbered yet."""
    sides = (
        _side_node(of_node, view, side, features, points, config)
        for side in side_views(view.camera, config.views)
    )
    return [node for node in sides if node is not None]


def gather_sides(
    described: Sequence[TopoNode], kind: str, config: SideNodesConfig
) -> SideNodes | None:
    """All side nodes of a map, by features of one kind, numbered, with what ranks them by looks;
    None without any. Each knows the node that it is of."""
    if len(described) == 0:
        return None
    nodes = Shelf(
        replace(node, summary=replace(node.summary, node_id=k)) for k, node in enumerate(described)
    )
    model = _coarse(nodes, config.vlad).to_model()
    model = replace(
        model, arrays={**model.arrays, "centres": np.array([_centre(node) for node in nodes])}
    )
    return SideNodes([node.summary for node in nodes], nodes, {model.name: model}, kind)


def _side_node(
    of_node: NodeSummary,
    view: FrameView,
    side: SideView,
    feature_config: FeatureConfig,
    points: MetricPointsConfig,
    config: SideNodesConfig,
) -> TopoNode | None:
    features = side.within(extract_features(side.picture(view.grey), feature_config))
    located = locate_points(side.in_picture(features, view.camera), view, points)
    # seen from the side camera's place at such a slant, a point says nothing of the wall before it
    side_from_cam = side.cam_from_side.inverse()
    points_side = side_from_cam.apply(located.points_cam)
    with np.errstate(invalid="ignore"):
        rows = np.flatnonzero(located.valid & (points_side[:, 2] > 0.1 * located.points_cam[:, 2]))[
            : config.max_points
        ]
    if len(rows) < config.min_points:
        return None
    turn = side_from_cam.rotation
    roots = np.linalg.cholesky(turn @ located.covariances[rows] @ turn.T)
    return TopoNode(
        replace(
            of_node,
            world_from_cam=of_node.world_from_cam @ side.cam_from_side,
            num_points=len(rows),
        ),
        side.camera,
        features.select(rows),
        points_side[rows].astype(np.float32),
        roots[:, *np.tril_indices(3)].astype(np.float32),
        b"",
    )


def _centre(node: TopoNode) -> Float[np.ndarray, " 3"]:
    """The world point in the middle of what the node shows."""
    return node.summary.world_from_cam.apply(
        np.median(node.points_cam.astype(np.float64), axis=0)[None]
    )[0]


def _coarse(nodes: Sequence[TopoNode], config: VladConfig) -> SurfVlad:
    def described(row: int) -> Float32[np.ndarray, "n d"]:
        return placed(
            nodes[row].features, nodes[row].camera.width, nodes[row].camera.height, config
        )

    words = learn_words_of([len(node.features) for node in nodes], described, config)
    return SurfVlad.fit(
        words,
        Shelf(vlad(described(row), words) for row in range(len(nodes))),
        np.arange(len(nodes)),
        config,
    )
