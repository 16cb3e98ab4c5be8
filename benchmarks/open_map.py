"""A map of 1,000 nodes: time to open it, to construct a localizer on it, to read a node, and its
bytes a node.

    python benchmarks/open_map.py [num_nodes]

Times are minima over several runs, in ms. The nodes are made up: 800 points each, a template of the
usual size.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import Localizer
from topoloc.mapping.build import BuildConfig
from topoloc.mapping.topomap import Edge, Layer, NodeSummary, PlaceImage, TopoMetricMap, TopoNode
from topoloc.retrieval.coarse import VladConfig
from topoloc.retrieval.vlad import SurfVlad

NUM_POINTS = 800
IMAGES_A_NODE = 3


def made_up_map(num_nodes: int) -> TopoMetricMap:
    rng = np.random.default_rng(0)
    camera = Camera.pinhole(640, 480, 500.0, 500.0, 320.0, 240.0)
    smooth = cv2.GaussianBlur(rng.integers(0, 256, (240, 320), dtype=np.uint8), (0, 0), 3.0)
    jpeg, small = (
        cv2.imencode(".jpg", cv2.resize(smooth, size))[1].tobytes()
        for size in ((320, 240), (213, 160))
    )
    descriptors = unit(rng.standard_normal((NUM_POINTS, 64)))
    points_img, column = (
        rng.uniform(0, 480, (NUM_POINTS, 2)).astype(np.float32),
        np.ones(NUM_POINTS, np.float32),
    )
    features = Features(points_img, column, column, column, descriptors)
    points, covs = (
        rng.uniform(1, 9, (NUM_POINTS, 3)).astype(np.float32),
        rng.uniform(0, 1, (NUM_POINTS, 6)).astype(np.float32),
    )
    poses = [Rigid3(np.eye(3), np.array([float(k), 0.0, 0.0])) for k in range(num_nodes)]
    summaries = [
        NodeSummary(k, "made up", f"{k:06d}.png", k, pose, NUM_POINTS)
        for k, pose in enumerate(poses)
    ]
    image_nodes = np.repeat(np.arange(num_nodes), IMAGES_A_NODE)
    config = VladConfig()
    vectors, projection = (
        unit(rng.standard_normal(s))
        for s in ((len(image_nodes), config.dimension), (config.dimension, config.num_words * 66))
    )
    words = unit(rng.standard_normal((config.num_words, 66)))  # descriptors with their places
    coarse = SurfVlad(words, projection[0], projection, vectors, image_nodes, config)
    effective = BuildConfig()
    nodes = [TopoNode(summary, camera, features, points, covs, jpeg) for summary in summaries]
    return TopoMetricMap(
        summaries,
        {"surf": Layer(nodes, {SurfVlad.name: coarse.to_model()})},
        [Edge(k, k + 1) for k in range(num_nodes - 1)],
        [
            PlaceImage("made up", f"{n}.png", int(node), poses[node], small)
            for n, node in enumerate(image_nodes)
        ],
        replace(effective, nodes=effective.nodes.resolved(4.0)),
    )


def unit(array: np.ndarray) -> np.ndarray:
    return (array / np.linalg.norm(array, axis=-1, keepdims=True)).astype(np.float32)


def shortest_ms(action: Callable[[], object], num_runs: int = 15) -> float:
    times = []
    for _ in range(num_runs):
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return min(times) * 1e3


def main() -> None:
    num_nodes = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "made_up.topo"
        start = time.perf_counter()
        made_up_map(num_nodes).save(path)
        print(f"write      {time.perf_counter() - start:8.2f} s")
        num_bytes = path.stat().st_size
        print(
            f"size       {num_bytes / 1e6:8.1f} MB, {num_bytes / num_nodes / 1e3:.1f} KB a node of"
            f" {NUM_POINTS} points"
        )
        print(f"open       {shortest_ms(lambda: TopoMetricMap.load(path)):8.2f} ms")
        print(
            f"localizer  {shortest_ms(lambda: Localizer(TopoMetricMap.load(path))):8.2f} ms,"
            " opening included"
        )
        topomap = TopoMetricMap.load(path)
        print(f"one node   {shortest_ms(lambda: topomap.nodes[num_nodes // 2]):8.2f} ms")


if __name__ == "__main__":
    main()
