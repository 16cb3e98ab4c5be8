"""Choose the nodes and the landmarks that a smaller map keeps.

A node covers its own mapping images. Another node supports it by the number of landmarks recognised
in it. Each node counts only its best supporter among the nodes that stay. This is the facility
location objective, which is submodular (Krause & Golovin 2014). The greedy algorithm removes the
node with the least loss, one after the other. It never removes a node without which some node would
lose its support. The support of nodes already removed counts in later steps.

Within a node, landmarks with a high observation probability are kept. They are spread over the
image, because a landmark beside others adds less. The objective is a submodular coverage: a cell of
the image counts as the square root of the sum of its probabilities (greedy choice).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Int

from topoloc.mapping.landmark_statistics import LandmarkStatistics
from topoloc.mapping.node_drafts import collect_virtual_nodes, observe_node
from topoloc.mapping.nodes import find_nearest_nodes
from topoloc.mapping.storage.entries import change_each
from topoloc.mapping.topomap import Edge, PlaceImage, TopoMetricMap, TopoNode
from topoloc.node_ids import NodeId, Row
from topoloc.retrieval.coarse import CoarseModel


def transform_nodes(
    topomap: TopoMetricMap, transform: Callable[[TopoNode], TopoNode]
) -> TopoMetricMap:
    """Return the map with each node transformed at every access, or the same map if `transform`
    returns all nodes unchanged."""
    if all(transform(node) is node for layer in topomap.layers.values() for node in layer.nodes):
        return topomap
    layers = {
        kind: replace(layer, nodes=change_each(layer.nodes, transform))
        for kind, layer in topomap.layers.items()
    }
    return replace(topomap, layers=layers)


def select_landmarks(node: TopoNode, kept: Int[np.ndarray, " k"]) -> TopoNode:
    """Return the node with the landmarks `kept` (rows in increasing order) and their session
    statistics."""
    new_row = np.full(len(node.features), -1)
    new_row[kept] = np.arange(len(kept))
    session_statistics = []
    for of_session in node.session_statistics:
        stays = new_row[of_session.rows] >= 0
        if stays.any():
            names, rows = ("roots", "pulls", "expected", "seen"), new_row[of_session.rows[stays]]
            parts = (getattr(of_session, name)[stays] for name in names)
            session_statistics.append(LandmarkStatistics(of_session.session_id, rows, *parts))
    stored = node.stored_descriptors
    return replace(
        node,
        summary=replace(node.summary, num_points=len(kept)),
        features=node.features.select(kept),
        points_cam=node.points_cam[kept],
        point_sqrt_covs=node.point_sqrt_covs[kept],
        session_statistics=session_statistics,
        stored_descriptors=None if stored is None else stored[kept],
    )


def find_vanished(node: TopoNode) -> Bool[np.ndarray, " n"]:
    """Return the mask of landmarks that later sessions never saw although they saw the rest of the
    node.

    The number of missed images must be large enough: a session that finds a third of the landmarks
    misses an existing one in four images with a probability of one in five.
    """
    # Minimum number of images of later sessions that should have shown a landmark, before it
    # can count as vanished.
    min_expected = 4
    # A landmark counts as vanished if an existing landmark would stay unseen in all these
    # images with at most this probability. The probability follows from the shares that the
    # sessions saw of the node.
    max_chance = 0.02
    # If more than this share of a node's landmarks would count as vanished, none of them
    # does.
    max_gone_share = 0.7
    num = len(node.features)
    expected, seen, log_missed = np.zeros(num, np.int64), np.zeros(num, np.int64), np.zeros(num)
    for session_statistics in node.session_statistics:
        later = session_statistics.session_id != node.summary.session_id
        if later and session_statistics.is_reobserved():
            rows, own = session_statistics.rows, session_statistics.expected
            num_seen = session_statistics.seen.sum(dtype=np.int64)
            share = num_seen / max(int(own.sum(dtype=np.int64)), 1)
            expected[rows] += own
            seen[rows] += session_statistics.seen
            log_missed[rows] += own * np.log1p(-min(share, 0.99))
    vanished = (expected >= min_expected) & (seen == 0) & (log_missed <= np.log(max_chance))
    return vanished if vanished.sum() <= max_gone_share * num else np.zeros(num, bool)


def choose_landmarks(
    node: TopoNode, rows: Int[np.ndarray, " m"], most: int
) -> Int[np.ndarray, " k"]:
    """Select the rows that a node keeps. Greedy choice: each next landmark adds most to the
    coverage of its cell."""
    cells = 8  # number of cell columns in the image. The kept landmarks are spread over the cells
    size = node.camera.width / cells
    cell = (node.features.points_img[rows] / size).astype(np.int64)
    key = cell[:, 1] * (cells + 1) + cell[:, 0]
    # the probability of being seen if it should be visible, over all sessions (Laplace's rule)
    expected, seen = np.ones(len(node.features)) * 2.0, np.ones(len(node.features))
    for of_session in node.session_statistics:
        expected[of_session.rows] += of_session.expected
        seen[of_session.rows] += of_session.seen
    chances, gains = (seen / expected)[rows], np.empty(len(rows))
    for one in np.unique(key):
        of_cell = np.flatnonzero(key == one)
        best_first = of_cell[np.argsort(-chances[of_cell], kind="stable")]
        total = np.cumsum(chances[best_first])
        # gains decrease within a cell, so sorting is the greedy choice
        gains[best_first] = np.sqrt(total) - np.sqrt(total - chances[best_first])
    return np.sort(np.argsort(-gains, kind="stable")[:most])


_PER_VECTOR_ARRAYS = ("vectors", "centres", "cell_vectors")


@dataclass(frozen=True, eq=False)
class NodeSupport:
    """Hold how well nodes support each other, by row.

    `landmarks[v, k]` counts the landmarks of node `supporters[v, k]` that are recognised in node v.
    The node itself is among its supporters, with all its landmarks. `num_images` counts the mapping
    images of each node.
    """

    supporters: Int[np.ndarray, "nodes k"]
    landmarks: Int[np.ndarray, "nodes k"]
    num_images: Int[np.ndarray, " nodes"]


def compute_node_support(topomap: TopoMetricMap, num_compared: int) -> NodeSupport:
    """Compare each node with its `num_compared` nearest nodes by Eq. 1.

    If a map has several feature types, the type that recognises most counts.

    Raises:
        MapError: a node cannot be read.
    """
    poses, lambda_rot = topomap.node_poses, topomap.config.lambda_rot
    count = min(num_compared + 1, len(topomap.summaries))
    nearest = [
        find_nearest_nodes(summary.world_from_cam, poses, lambda_rot, count)
        for summary in topomap.summaries
    ]
    supporters = np.array(nearest, np.int64)
    landmarks = np.zeros(supporters.shape, np.int64)
    for layer in topomap.layers.values():
        nodes = layer.nodes
        for row, others in enumerate(supporters):
            view = nodes[row]
            seen = [
                _count_recognised_landmarks(nodes[k], view) if k != row else len(view.features)
                for k in others.tolist()
            ]
            landmarks[row] = np.maximum(landmarks[row], seen)
    owners = [topomap.row_of(image.node_id) for image in topomap.place_images]
    num_images = np.bincount(owners, minlength=len(supporters))
    return NodeSupport(supporters, landmarks, np.maximum(num_images, 1))


def _count_recognised_landmarks(node: TopoNode, view: TopoNode) -> int:
    """Count the landmarks of `node` that are found in the features of `view` near their
    projections."""
    if len(node.features) == 0 or len(view.features) == 0:
        return 0
    cam_from_node = view.summary.world_from_cam.inverse() @ node.summary.world_from_cam
    return len(observe_node(node, view.features, view.camera, cam_from_node).rows)


def iterate_node_removals(
    support: NodeSupport, min_held: int
) -> Iterable[tuple[Row, Int[np.ndarray, " nodes"]]]:
    """Yield the rows of nodes in the order of removal, each with the current supporter of every
    node.

    The iteration ends if any further removal would leave a node with fewer than `min_held`
    recognised landmarks.
    """
    num = len(support.supporters)
    is_kept, weights = np.ones(num, bool), np.log1p(support.landmarks)
    while is_kept.sum() > 1:
        known = np.where(is_kept[support.supporters], support.landmarks, -1)
        order = np.argsort(-known, axis=1, kind="stable")
        first, second = order[:, 0], order[:, min(1, order.shape[1] - 1)]
        rows = np.arange(num)
        supporter, remaining = support.supporters[rows, first], known[rows, second]
        losses = support.num_images * (weights[rows, first] - np.log1p(np.maximum(remaining, 0)))
        loss_of_supporter = np.bincount(supporter, losses, minlength=num)
        loss_of_supporter[supporter[(remaining < min_held) | (first == second)]] = np.inf
        loss_of_supporter[~is_kept] = np.inf
        row = Row(int(loss_of_supporter.argmin()))
        if not np.isfinite(loss_of_supporter[row]):
            return
        is_kept[row] = False
        yield row, np.where(supporter == row, support.supporters[rows, second], supporter)


def remove_nodes(
    topomap: TopoMetricMap, removed: Sequence[Row], supporter: Int[np.ndarray, " nodes"]
) -> TopoMetricMap:
    """Return the map without the nodes `removed`, given the row of the supporting node of each
    node.

    Edges and images of a removed node pass to its supporter. One mapping image and one global
    descriptor of each removed node are kept.
    """
    gone = set(removed)
    kept = [row for row in topomap.rows if row not in gone]
    ids = [summary.node_id for summary in topomap.summaries]
    new_id, layers = {ids[row]: ids[int(supporter[row])] for row in gone}, {}
    for kind, layer in topomap.layers.items():
        models = {
            name: _reassign_descriptors(model, new_id)
            for name, model in layer.coarse_models.items()
        }
        nodes = change_each(kept, layer.nodes.__getitem__)
        layers[kind] = replace(layer, nodes=nodes, coarse_models=models)
    sides = topomap.sides
    if sides is not None and any(summary.of_node in new_id for summary in sides.summaries):
        staying = [node for node in sides.nodes if node.summary.of_node not in new_id]
        sides = collect_virtual_nodes(staying, sides.kind)
    edges = {
        Edge(*(new_id.get(one, one) for one in (edge.source_id, edge.target_id)))
        for edge in topomap.edges
    }
    return replace(
        topomap,
        summaries=[topomap.summaries[row] for row in kept],
        layers=layers,
        edges=sorted(edge for edge in edges if edge.source_id != edge.target_id),
        place_images=_reassign_images(topomap.place_images, new_id),
        sides=sides,
    )


def _reassign_images(
    images: Sequence[PlaceImage], new_id: Mapping[NodeId, NodeId]
) -> list[PlaceImage]:
    """Return the images of the kept nodes and the first image of each removed node, which passes to
    its supporter."""
    kept, seen = list[PlaceImage](), set[NodeId]()
    for image in images:
        if image.node_id not in new_id:
            kept.append(image)
        elif image.node_id not in seen:
            seen.add(image.node_id)
            kept.append(replace(image, node_id=new_id[image.node_id]))
    return kept


def _reassign_descriptors(model: CoarseModel, new_id: Mapping[NodeId, NodeId]) -> CoarseModel:
    """Return a coarse localizer with the global descriptors of removed nodes reduced to one each.
    The descriptor nearest to the node's mean is kept and passes to the supporter."""
    vectors, of_node = model.arrays.get("vectors"), model.arrays.get("node_ids")
    if vectors is None or of_node is None:
        return model  # it has one output per node; those of missing nodes are ignored later
    is_kept, ids = np.ones(len(of_node), bool), of_node.copy()
    for node_id, supporter_id in new_id.items():
        rows = np.flatnonzero(of_node == node_id)
        if len(rows):
            own = vectors[rows].astype(np.float32)
            is_kept[rows] = np.arange(len(rows)) == int((own @ own.mean(axis=0)).argmax())
            ids[rows] = supporter_id
    arrays = {
        name: array[is_kept] if len(array) == len(of_node) and name in _PER_VECTOR_ARRAYS else array
        for name, array in model.arrays.items()
    }
    return replace(model, arrays=arrays | {"node_ids": ids[is_kept]})


def select_removed_nodes(
    support: NodeSupport, min_held: int, is_enough: Callable[[list[Row]], bool]
) -> tuple[list[Row], Int[np.ndarray, " nodes"]] | None:
    """Return the nodes to remove and the final supporter of every node.

    Removal ends when `is_enough` returns true or no further node can be removed. Returns None if no
    node can be removed.
    """
    removed, chosen = list[Row](), None
    for row, supporter in iterate_node_removals(support, min_held):
        removed.append(row)
        chosen = removed, supporter
        if is_enough(removed):
            break
    return chosen
