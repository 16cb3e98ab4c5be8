"""Times of patch normalisation, feature extraction and matching.

    python benchmarks/feature_speed.py [--shared ../shared] [--repeats 60]

Milliseconds, minimum and median over the repeats, after warm-up.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from topoloc.features.extraction import (
    FeatureConfig,
    PatchNormalizationConfig,
    extract_from_normalized,
    normalize_image,
    patch_normalize,
)
from topoloc.features.features import MatchingConfig
from topoloc.features.matching import match_features, match_pooled
from topoloc.recordings.frame import to_grey
from topoloc.recordings.open import open_sequence

RECORDINGS = {
    "kitchen": "seven_scenes/kitchen/seq-01",
    "zed": "zed_lab/session1",
    "kitti": "kitti/sequences/street1",
}


@dataclass(frozen=True)
class Args:
    shared: Path = Path(os.environ.get("TOPOLOC_SHARED", Path(__file__).parents[2] / "shared"))
    repeats: int = 60


def report(name: str, function: Callable[[], object], repeats: int) -> None:
    times = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        function()
        times.append(1e3 * (time.perf_counter() - start))
    print(f"  {name:44s} {min(times[1:]):7.2f} {np.median(times[1:]):7.2f}")


def time_extraction(image: np.ndarray, repeats: int) -> None:
    for num_threads in (1, 2):
        for name, config in (
            ("paper", PatchNormalizationConfig.paper()),
            ("17 round", PatchNormalizationConfig(shape="round")),
            ("65 square", PatchNormalizationConfig(65, 24.0)),
        ):
            report(
                f"patch normalisation {name}, {num_threads} threads",
                lambda c=config, n=num_threads: patch_normalize(image, c, n),
                repeats,
            )
        for config in (
            FeatureConfig(),
            FeatureConfig(normalization="none"),
            FeatureConfig(kind="sift"),
        ):
            normalized = normalize_image(image, config, num_threads)
            name = f"{config.kind} on {config.normalization}, {num_threads} threads"
            report(
                name,
                lambda c=config, i=normalized, n=num_threads: extract_from_normalized(i, c, n),
                repeats,
            )


def time_matching(
    repeats: int, num_query: int = 850, num_train: int = 4000, size: int = 64
) -> None:
    random = np.random.default_rng(0)
    train = random.normal(size=(num_train, size))
    query = random.normal(size=(num_query, size))
    query[: num_query // 2] = train[: num_query // 2] + 0.3 * random.normal(
        size=(num_query // 2, size)
    )
    train, query = (
        (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32) for d in (train, query)
    )
    points, radii = random.uniform(-5, 5, (num_train, 3)), np.full(num_train, 0.05)
    config = MatchingConfig()
    report("exact", lambda: match_features(query, train, config), repeats)
    report(
        "exact, no mutual check",
        lambda: match_features(query, train, MatchingConfig(mutual=False)),
        repeats,
    )
    report("exact, pooled", lambda: match_pooled(query, train, points, radii, config), repeats)
    report(
        "FLANN",
        lambda: match_features(query, train, MatchingConfig(method="flann")),
        max(repeats // 10, 3),
    )
    report("the bare matrix product", lambda: query @ train.T, repeats)


def main(args: Args) -> None:
    for name, path in RECORDINGS.items():
        image = to_grey(open_sequence(args.shared / "data" / path)[10].image)
        print(f"{name}, {image.shape[1]} x {image.shape[0]}: minimum and median, ms")
        time_extraction(image, args.repeats)
    print("matching 850 with 4000 descriptors of 64 numbers")
    time_matching(args.repeats)


if __name__ == "__main__":
    main(tyro.cli(Args))
