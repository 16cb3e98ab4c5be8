"""Milliseconds of a query, stage by stage, beside the paper's scheme on OpenCV in the same run.

    python benchmarks/query_speed.py [--shared ../shared] [--num-queries 60]

The peer is what a wheel of OpenCV gives of the paper as written: SIFT (no wheel has SURF), one
node, FLANN with the ratio test, RANSAC and LM by OpenCV; D_thresh 2. Both take turns, picture by
picture, so that a machine's changing speed meets both.
"""

from __future__ import annotations

import argparse
import os
import resource
from pathlib import Path

import numpy as np

from topoloc.features.extraction import FeatureConfig
from topoloc.features.features import MatchingConfig
from topoloc.geometry.absolute_pose import AbsolutePoseConfig
from topoloc.localization.guided import GuidedConfig
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.map_facts.map_building import build_map
from topoloc.mapping.build import BuildConfig
from topoloc.mapping.nodes import NodeConfig
from topoloc.recordings.open import open_sequence

PEER = "the paper's scheme on OpenCV"
AS_WRITTEN = LocalizerConfig(
    num_candidates=1,
    guided=GuidedConfig(num_nodes=0),
    matching=MatchingConfig(method="flann"),
    pose=AbsolutePoseConfig(method="opencv", max_reprojection_error_px=8.0),
    num_first_features=1_000_000,
)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--shared", type=Path, default=Path(os.environ.get("TOPOLOC_SHARED", "../shared"))
    )
    parser.add_argument("--num-queries", type=int, default=60)
    arguments = parser.parse_args()
    kitchen = arguments.shared / "data" / "seven_scenes" / "kitchen"
    mapping, queries = open_sequence(f"{kitchen}@0-59/100"), open_sequence(f"{kitchen}@60-99/100")
    ours = Localizer(build_map(mapping, BuildConfig(nodes=NodeConfig(d_thresh=0.5))))
    sift = FeatureConfig(kind="sift", normalization="none")
    peer = Localizer(
        build_map(
            mapping, BuildConfig(nodes=NodeConfig(d_thresh=2.0, lambda_rot=2.0), features=sift)
        ),
        AS_WRITTEN,
    )
    times: dict[str, list[float]] = {}
    for i in range(-5, arguments.num_queries):
        frame = queries[i % len(queries)]
        assert frame.camera is not None
        peer_ms = peer.localize(frame.image, frame.camera).times_ms["total"]
        our_ms = ours.localize(frame.image, frame.camera).times_ms
        if i >= 0:  # the first five warm up
            for stage, ms in {PEER: peer_ms, **our_ms}.items():
                times.setdefault(stage, []).append(ms)
    for stage, ms in times.items():
        print(
            f"{stage:28s} median {np.median(ms):7.2f} ms  quartiles {np.percentile(ms, 25):.2f} to"
            f" {np.percentile(ms, 75):.2f}"
        )
    print(f"ratio, ours to the peer's: {np.median(times['total']) / np.median(times[PEER]):.2f}")
    print(
        "peak memory of this process, map building included:"
        f" {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB"
    )


if __name__ == "__main__":
    main()
