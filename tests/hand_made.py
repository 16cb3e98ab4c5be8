"""Make a small map and results by hand, so that each figure of an evaluation is known."""

from __future__ import annotations

import cv2
import numpy as np

from topoloc.evaluation.metrics import EvaluatedQuery
from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.localization.result import CandidateNode, Localization, NotLocalized
from topoloc.mapping.config import MapConfig
from topoloc.mapping.topomap import Edge, Layer, NodeSummary, TopoMetricMap, TopoNode

TIMES_MS = {
    "patch_normalization": 2.0,
    "features": 10.0,
    "coarse": 1.0,
    "matching": 4.0,
    "pnp": 3.0,
    "total": 21.0,
}


def pose(x: float, yaw_deg: float = 0.0) -> Rigid3:
    return Rigid3(
        exp_so3(np.array([0.0, np.deg2rad(yaw_deg), 0.0])), np.array([x, 0.1 * x, 0.5 * x])
    )


def answer(
    query: str,
    x: float,
    error_m: float,
    error_deg: float,
    node_id: int = 0,
    first_candidate: int = 0,
) -> EvaluatedQuery:
    """Return a localized query at `x` with this error. Its nearest node is 0."""
    off = Rigid3(
        exp_so3(np.array([np.deg2rad(error_deg), 0.0, 0.0])), np.array([0.0, 0.0, error_m])
    )
    truth = pose(x)
    found = Rigid3(off.rotation @ truth.rotation, truth.translation + off.translation)
    candidates = [CandidateNode(first_candidate, 0.9), CandidateNode(1 - first_candidate, 0.4)]
    result = Localization(found, 1e-4 * np.eye(6), 0.9, node_id, candidates, 50, 40, TIMES_MS)
    return EvaluatedQuery(query, result, truth, 0, "walk", picture)


def lost(query: str, x: float, reason: str = "too_few_inliers") -> EvaluatedQuery:
    """Return a query at `x` without a pose."""
    result = NotLocalized(reason, [CandidateNode(1, 0.2)], 9, 3, TIMES_MS)  # pyright: ignore[reportArgumentType]
    return EvaluatedQuery(query, result, pose(x), 0, "walk", picture)


def elsewhere(query: str, accepted: bool) -> EvaluatedQuery:
    """Return an out-of-map image."""
    if accepted:
        result = Localization(
            pose(0.0), np.eye(6), 0.9, 1, [CandidateNode(1, 0.3)], 12, 12, TIMES_MS
        )
        return EvaluatedQuery(query, result, None, None, "moon", picture)
    return EvaluatedQuery(
        query,
        NotLocalized("not_in_map", [], 5, 0, {"features": 30.0, "total": 41.0}),
        None,
        None,
        "moon",
        picture,
    )


def picture() -> np.ndarray:
    return np.random.default_rng(7).integers(0, 256, (300, 1200, 3), dtype=np.uint8)


def two_nodes() -> TopoMetricMap:
    """Return a map with nodes at x = 0 and x = 1."""
    camera = Camera.pinhole(40, 30, 30.0, 30.0, 19.5, 14.5)
    jpeg = cv2.imencode(".jpg", np.full((30, 40), 90, np.uint8))[1].tobytes()
    none = np.zeros(0, np.float32)
    features = Features(
        np.zeros((0, 2), np.float32), none, none, none, np.zeros((0, 64), np.float32)
    )
    points, roots = np.zeros((0, 3), np.float32), np.zeros((0, 6), np.float32)
    summaries = [NodeSummary(i, "walk", f"{i}.png", i, pose(float(i)), 0) for i in range(2)]
    nodes = [TopoNode(summary, camera, features, points, roots, jpeg) for summary in summaries]
    return TopoMetricMap(summaries, {"surf": Layer(nodes)}, [Edge(0, 1)], [], MapConfig(), 1.0)


MAP_INFO = {
    "path": "folder/two & <more>.topo",
    "bytes": 1_234_567,
    "num_nodes": 2,
    "num_points": 0,
    "num_side_nodes": 0,
    "num_place_images": 0,
    "length_m": 1.0,
    "extent_m": [1.0, 0.1, 0.5],
    "recordings": ["walk"],
    "coarse": ["surf-vlad"],
    "config": {},
}
