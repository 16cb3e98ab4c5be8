"""Whole nodes that a map can do without: what they show is shown by nodes that stay.

A node stands for the pictures that belong to it, its own first. It is held by the one among the
nodes that stay whose landmarks are recognised in it most; what many show alike counts once
(facility location, which is submodular: Krause & Golovin 2014). So the node goes whose loss takes
least from the places it stands for and holds, one after the other, never one that nothing else
holds. The node that holds a place then stands for its pictures, too: what goes today is not
forgotten when the next one is chosen.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int

from topoloc.lifelong.lazy_sequences import SelectedSequence
from topoloc.lifelong.node_observation import observe_node
from topoloc.mapping.nodes import NearestNodeSearch, NodePoses
from topoloc.mapping.topomap import Edge, PlaceImage, TopoMetricMap, TopoNode, VirtualNodes
from topoloc.mapping.virtual_nodes import collect_virtual_nodes
from topoloc.retrieval.coarse import CoarseModel

_PER_VECTOR_ARRAYS = ("vectors", "centres", "cell_vectors")


@dataclass(frozen=True, eq=False)
class NodeSupport:
    """How firmly nodes hold each other, by their rows: landmarks of node `by[v, k]` that are
    recognised in node v, `landmarks[v, k]`. The node itself is among them, with all of its own.
    `num_images` counts what each node stands for."""

    supporters: Int[np.ndarray, "nodes k"]
    landmarks: Int[np.ndarray, "nodes k"]
    num_images: Int[np.ndarray, " nodes"]


def compute_node_support(topomap: TopoMetricMap, num_compared: int) -> NodeSupport:
    """Each node compared with so many others, the nearest by Eq. 1. Of several kinds of features
    the one that recognises most counts.

    Raises:
        MapError: from reading the nodes.
    """
    config = topomap.config
    lambda_rot = config.nodes.lambda_rot
    assert lambda_rot is not None, "a map's own configuration is resolved"
    nearest = NearestNodeSearch(
        NodePoses.of([summary.world_from_cam for summary in topomap.summaries]), lambda_rot
    )
    count = min(num_compared + 1, len(topomap.summaries))
    supporters = np.array(
        [nearest.rows(summary.world_from_cam, count) for summary in topomap.summaries], np.int64
    )
    landmarks = np.zeros(supporters.shape, np.int64)
    for kind in topomap.kinds:
        nodes = topomap.nodes_of(kind)
        for row, others in enumerate(supporters):
            seen = [
                _count_recognised_landmarks(nodes[int(k)], nodes[row], topomap)
                if k != row
                else len(nodes[row].features)
                for k in others
            ]
            landmarks[row] = np.maximum(landmarks[row], seen)
    row_of = {summary.node_id: row for row, summary in enumerate(topomap.summaries)}
    owners = [row_of[image.node_id] for image in topomap.place_images]
    return NodeSupport(
        supporters, landmarks, np.maximum(np.bincount(owners, minlength=len(supporters)), 1)
    )


def _count_recognised_landmarks(node: TopoNode, view: TopoNode, topomap: TopoMetricMap) -> int:
    """Landmarks of a node that are found in what another one shows, where they must be."""
    if len(node.features) == 0 or len(view.features) == 0:
        return 0
    cam_from_node = view.summary.world_from_cam.inverse() @ node.summary.world_from_cam
    return len(observe_node(node, view.features, view.camera, cam_from_node, topomap.config).rows)


def iterate_node_removals(
    support: NodeSupport, min_held: int
) -> Iterable[tuple[int, Int[np.ndarray, " nodes"]]]:
    """The rows of nodes in the order in which they go, with the row of the node that holds each
    place then. It ends where every further one would leave a place with fewer than `min_held`
    landmarks recognised."""
    num = len(support.supporters)
    is_kept, weights = np.ones(num, bool), np.log1p(support.landmarks)
    while is_kept.sum() > 1:
        known = np.where(is_kept[support.supporters], support.landmarks, -1)
        order = np.argsort(-known, axis=1, kind="stable")
        first, second = order[:, 0], order[:, min(1, order.shape[1] - 1)]
        rows = np.arange(num)
        supporter = support.supporters[rows, first]
        remaining = known[rows, second]
        losses = support.num_images * (weights[rows, first] - np.log1p(np.maximum(remaining, 0)))
        loss_of_supporter = np.bincount(supporter, losses, minlength=num)
        loss_of_supporter[supporter[(remaining < min_held) | (first == second)]] = np.inf
        loss_of_supporter[~is_kept] = np.inf
        row = int(loss_of_supporter.argmin())
        if not np.isfinite(loss_of_supporter[row]):
            return
        is_kept[row] = False
        yield row, np.where(supporter == row, support.supporters[rows, second], supporter)


def remove_nodes(
    topomap: TopoMetricMap, removed: Sequence[int], supporter: Int[np.ndarray, " nodes"]
) -> TopoMetricMap:
    """The map without these rows, of nodes of which `supporter` (rows) says which holds the place
    of each: edges and pictures are the holder's then. Of a dropped node's mapping pictures one
    stays, and one place vector."""
    gone = set(removed)
    kept = [row for row in range(len(topomap.summaries)) if row not in gone]
    ids = [summary.node_id for summary in topomap.summaries]
    new_id = {ids[row]: ids[int(supporter[row])] for row in gone}
    nodes = {kind: SelectedSequence(topomap.nodes_of(kind), kept) for kind in topomap.kinds}
    edges = {
        tuple(new_id.get(one, one) for one in (edge.source_id, edge.target_id))
        for edge in topomap.edges
    }
    return replace(
        topomap,
        summaries=[topomap.summaries[row] for row in kept],
        nodes=nodes.pop(topomap.kind),
        other_kinds=nodes,
        edges=[Edge(source, target) for source, target in sorted(edges) if source != target],
        place_images=_reassign_images(topomap.place_images, new_id),
        coarse_models={
            name: _reassign_descriptors(model, new_id)
            for name, model in topomap.coarse_models.items()
        },
        sides=_remove_virtual_nodes(topomap, new_id),
    )


def _reassign_images(images: Sequence[PlaceImage], new_id: Mapping[int, int]) -> list[PlaceImage]:
    """Of each dropped node the first picture, which is the holder's now, and all others."""
    kept, seen = list[PlaceImage](), set[int]()
    for image in images:
        if image.node_id not in new_id:
            kept.append(image)
        elif image.node_id not in seen:
            seen.add(image.node_id)
            kept.append(replace(image, node_id=new_id[image.node_id]))
    return kept


def _reassign_descriptors(model: CoarseModel, new_id: Mapping[int, int]) -> CoarseModel:
    """A coarse localizer by vectors: of each dropped node the one nearest to the middle of its own,
    which leads to the holder now."""
    vectors, of_node = model.arrays.get("vectors"), model.arrays.get("node_ids")
    if vectors is None or of_node is None:
        return (
            model  # it has an output a node; what it says of nodes that are not there is left out
        )
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


def _remove_virtual_nodes(topomap: TopoMetricMap, new_id: Mapping[int, int]) -> VirtualNodes | None:
    """The walls beside the nodes that stay."""
    sides = topomap.sides
    if sides is None or not any(summary.of_node in new_id for summary in sides.summaries):
        return sides
    return collect_virtual_nodes(
        [node for node in sides.nodes if node.summary.of_node not in new_id],
        sides.kind,
        topomap.config.sides,
    )


def select_removed_nodes(
    support: NodeSupport, min_held: int, is_enough: Callable[[list[int]], bool]
) -> tuple[list[int], Int[np.ndarray, " nodes"]] | None:
    """The first so many nodes that go, until it `is_enough` or no further one can go, and what
    holds each place then; None where none can go."""
    removed, last = list[int](), None
    for row, supporter in iterate_node_removals(support, min_held):
        removed.append(row)
        last = supporter
        if is_enough(removed):
            break
    return (removed, last) if last is not None else None
