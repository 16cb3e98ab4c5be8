"""Measure milliseconds of one image in each coarse localizer, with the nearest neighbour search, on
this machine's processor.

    python benchmarks/coarse_speed.py [--threads 2] [--networks ...] [--size 224x224]

Weights are random, because they do not change the time. `wall` is the least and the median of the
runs. `core` is the least time of all cores together, which other programs disturb less. The
features of the processor are printed first.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import torch

from topoloc.compiled import set_num_threads
from topoloc.features.features import Features
from topoloc.retrieval.coarse import CoarseLocalizer, CoarseModel
from topoloc_training.backbones import Backbone
from topoloc_training.classifier_config import (
    BackboneName,
    CnnNnConfig,
    NetworkInputConfig,
    VladNnConfig,
)
from topoloc_training.cnn_fc import CnnFc, NodeClassifier
from topoloc_training.cnn_nn import DEPTHS as CNN_DEPTHS, PooledFeatures
from topoloc_training.inference import has_bfloat16
from topoloc_training.place_vectors import NetworkDescriptorLocalizer
from topoloc_training.stored_networks import to_arrays
from topoloc_training.vlad_nn import DEPTHS as VLAD_DEPTHS, VladNetwork

NUM_NODES, NUM_IMAGES, DIMENSION = 100, 2000, 256
NETWORKS: tuple[tuple[str, BackboneName], ...] = (
    ("cnn-nn", "squeezenet1_1"),
    ("vlad-nn", "squeezenet1_1"),
    ("cnn-fc", "squeezenet1_1"),
    ("cnn-fc", "compact"),
    ("cnn-fc", "vgg11"),
    ("vlad-nn", "vgg16"),
)


def main() -> None:
    names = [f"{name}/{backbone}" for name, backbone in NETWORKS]
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--networks", nargs="+", default=names, choices=names)
    parser.add_argument("--size", default="224x224")
    parser.add_argument("--runs", type=int, default=15)
    arguments = parser.parse_args()
    set_num_threads(arguments.threads)
    print(
        f"{torch.backends.cpu.get_cpu_capability()}, bfloat16 in hardware: {has_bfloat16()},"
        f" {arguments.threads} threads"
    )
    width, height = map(int, arguments.size.split("x"))
    image = np.random.default_rng(0).integers(0, 255, (480, 640, 3), np.uint8)
    no_features = Features(
        *(np.zeros(shape, np.float32) for shape in ((0, 2), (0,), (0,), (0,), (0, 64)))
    )
    for name in arguments.networks:
        method, _, backbone = name.partition("/")
        localizer = made(method, backbone, NetworkInputConfig(width, height))
        localizer.rank(image, no_features, 4)
        walls, cores = [], []
        for _ in range(arguments.runs):
            wall, core = time.perf_counter(), time.process_time()
            localizer.rank(image, no_features, 4)
            walls.append((time.perf_counter() - wall) * 1e3)
            cores.append((time.process_time() - core) * 1e3)
        print(
            f"{name:<24}{arguments.size:>9}  wall {min(walls):7.1f} {np.median(walls):7.1f}  core"
            f" {min(cores):7.1f} ms",
            flush=True,
        )


def made(method: str, backbone: BackboneName, picture: NetworkInputConfig) -> CoarseLocalizer:
    """A localizer of this kind with random weights and vectors."""
    rng = np.random.default_rng(0)
    settings = {"backbone": backbone, "picture_shape": [213, 160]}
    if method == "cnn-fc":
        config = {"picture": {"width_px": picture.width_px, "height_px": picture.height_px}}
        settings |= {"config": config, "num_nodes": NUM_NODES, "temperature": 1.0}
        return CnnFc(
            CoarseModel("cnn-fc", settings, to_arrays(NodeClassifier(backbone, NUM_NODES)))
        )
    if method == "cnn-nn":
        c = CnnNnConfig()
        network: torch.nn.Module = PooledFeatures(
            backbone, CNN_DEPTHS[backbone], c.grid_rows, c.grid_columns, c.power
        )
        num_raw = (
            Backbone(backbone, None, CNN_DEPTHS[backbone]).num_channels
            * c.grid_rows
            * c.grid_columns
        )
    else:
        num_clusters = VladNnConfig().num_clusters
        network = VladNetwork(backbone, VLAD_DEPTHS[backbone], num_clusters)
        num_raw = Backbone(backbone, None, VLAD_DEPTHS[backbone]).num_channels * num_clusters
    settings["config"] = {"picture": {"width_px": picture.width_px, "height_px": picture.height_px}}
    vectors = rng.standard_normal((NUM_IMAGES, DIMENSION)).astype(np.float16)
    arrays = {
        "vectors": vectors,
        "node_ids": np.arange(NUM_IMAGES) // 20,
        "mean": np.zeros(num_raw, np.float32),
    }
    arrays["projection"] = rng.standard_normal((DIMENSION, num_raw)).astype(np.float16)
    return NetworkDescriptorLocalizer(
        CoarseModel(method, settings, to_arrays(network) | arrays), network, picture
    )


if __name__ == "__main__":
    main()
