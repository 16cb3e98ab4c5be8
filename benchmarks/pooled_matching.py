"""Compare three rules of the ratio test for points seen by several map nodes, on the kitchen of
7-Scenes.

    python benchmarks/pooled_matching.py [--shared ../shared]

Nodes are every tenth frame. A query is matched with the five nearest nodes but the two next to it.
A match is right if its map point falls within 4 pixels of the key point, under the pose from the
matches of all rules together. Printed are right matches, each key point of the query counted once
(geometric mean), and precision.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from topoloc.features.extraction import FeatureConfig, extract_features
from topoloc.features.features import MatchingConfig
from topoloc.features.matching import match_features, match_pooled
from topoloc.geometry.absolute_pose import estimate_absolute_pose
from topoloc.points.metric_points import locate_points
from topoloc.recordings.frame_preparation import prepare_frame
from topoloc.recordings.open import open_sequence

Rule = Callable[[np.ndarray, "Pool", float], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Args:
    shared: Path = Path(os.environ.get("TOPOLOC_SHARED", Path(__file__).parents[2] / "shared"))


@dataclass(frozen=True, eq=False)
class Pool:
    descriptors: np.ndarray
    points_world: np.ndarray
    sigmas: np.ndarray
    node_ids: np.ndarray

    @staticmethod
    def concatenate(parts: list[Pool]) -> Pool:
        return Pool(
            *(
                np.concatenate([getattr(part, name) for part in parts])
                for name in ("descriptors", "points_world", "sigmas", "node_ids")
            )
        )


def everything_rivals(query: np.ndarray, pool: Pool, ratio: float) -> tuple[np.ndarray, np.ndarray]:
    matches = match_features(query, pool.descriptors, MatchingConfig(ratio=ratio))
    return matches.query_idx, matches.train_idx


def best_of_the_nodes(query: np.ndarray, pool: Pool, ratio: float) -> tuple[np.ndarray, np.ndarray]:
    found = []
    for node_id in np.unique(pool.node_ids):
        rows = np.flatnonzero(pool.node_ids == node_id)
        matches = match_features(query, pool.descriptors[rows], MatchingConfig(ratio=ratio))
        found.append((matches.query_idx, rows[matches.train_idx], matches.distances))
    query_idx, train_idx, distances = (
        np.concatenate(column) for column in zip(*found, strict=True)
    )
    order = np.argsort(distances, kind="stable")
    _, first = np.unique(query_idx[order], return_index=True)
    return query_idx[order][first], train_idx[order][first]


def twins_within(num_sigmas: float) -> Rule:
    def rule(query: np.ndarray, pool: Pool, ratio: float) -> tuple[np.ndarray, np.ndarray]:
        radii = 0.01 + num_sigmas * pool.sigmas
        matches = match_pooled(
            query, pool.descriptors, pool.points_world, radii, MatchingConfig(ratio=ratio)
        )
        return matches.query_idx, matches.train_idx

    return rule


RULES: dict[str, Rule] = {
    "all others are rivals": everything_rivals,
    "ratio in each node, best kept": best_of_the_nodes,
    "twins within 3 sigma no rivals": twins_within(3.0),
    "twins within 6 sigma no rivals": twins_within(6.0),
    "twins within 12 sigma no rivals": twins_within(12.0),
}


def main(args: Args) -> None:
    sequence = open_sequence(args.shared / "data/seven_scenes/kitchen/seq-01")
    config = FeatureConfig()
    nodes = []
    for node_id in range(0, len(sequence), 10):
        frame = sequence[node_id]
        view = prepare_frame(frame)
        features = extract_features(view.grey, config)
        located = locate_points(features, view)
        rows = np.flatnonzero(located.valid)
        sigmas = np.sqrt(np.trace(located.covariances[rows], axis1=1, axis2=2))
        world_from_view = frame.world_from_cam @ view.view_from_cam.inverse()
        points_world = world_from_view.apply(located.points_cam[rows])
        nodes.append(
            Pool(features.descriptors[rows], points_world, sigmas, np.full(len(rows), node_id))
        )
    tallies: dict[tuple[str, float], list[tuple[int, int, int]]] = {}
    for query_idx in range(5, len(sequence), 20):
        view = prepare_frame(sequence[query_idx], with_depth=False)
        nearest = sorted(range(len(nodes)), key=lambda k, at=query_idx: abs(10 * k - at))[2:7]
        pool = Pool.concatenate([nodes[k] for k in nearest])
        features = extract_features(view.grey, config)
        found = {
            (name, ratio): rule(features.descriptors, pool, ratio)
            for name, rule in RULES.items()
            for ratio in (0.7, 0.8, 0.85)
        }
        rows, train_rows = (np.concatenate(column) for column in zip(*found.values(), strict=True))
        pose = estimate_absolute_pose(
            features.points_img[rows].astype(np.float64), pool.points_world[train_rows], view.camera
        )
        assert pose is not None
        for key, (rows, train_rows) in found.items():
            seen = view.camera.img_from_cam(
                pose.cam_from_world.apply(pool.points_world[train_rows])
            )
            right = np.linalg.norm(seen - features.points_img[rows], axis=1) < 4.0
            tallies.setdefault(key, []).append(
                (len(np.unique(rows[right])), int(right.sum()), len(rows))
            )
    for (name, ratio), tally in sorted(tallies.items()):
        once, right, total = np.array(tally).T
        print(
            f"{name:34s} ratio {ratio:.2f}  right {np.expm1(np.log1p(once).mean()):6.1f}  precision"
            f" {right.sum() / total.sum():.2f}"
        )


if __name__ == "__main__":
    main(tyro.cli(Args))
