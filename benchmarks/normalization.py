"""Compare normalisations of images by right matches, in unchanged light and in the dark, on real
recordings.

    python benchmarks/normalization.py [--shared ../shared] [--json FILE]

The first image of a pair is mapped (features with depth). The second is the query, unchanged and
with three reductions of light. Its pose relative to the first comes from SIFT on the unchanged
images. A match is right if the map point falls within 3 pixels of the query's key point. Every
variant may keep the same number of features.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import tyro

from topoloc.features.extraction import (
    FeatureConfig,
    PatchNormalizationConfig,
    extract_features,
    patch_normalize,
)
from topoloc.features.features import Features, MatchingConfig
from topoloc.features.matching import match_features
from topoloc.features.surf import extract_surf
from topoloc.geometry.absolute_pose import AbsolutePoseConfig, estimate_absolute_pose
from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.geometry.rigid import Rigid3
from topoloc.points.metric_points import locate_points
from topoloc.recordings.frame_preparation import PreparedFrame, prepare_frame
from topoloc.recordings.open import open_sequence

KITCHEN, ZED = "seven_scenes/kitchen/seq-01", "zed_lab/session{}"
# recording and frame of the map picture, of the query
PAIRS = [
    *(
        (KITCHEN, a, KITCHEN, b)
        for a, b in (
            (0, 5),
            (30, 40),
            (60, 80),
            (90, 105),
            (120, 140),
            (150, 160),
            (180, 200),
            (210, 220),
        )
    ),
    *(
        (KITCHEN, a, KITCHEN, b)
        for a, b in ((240, 255), (270, 290), (300, 320), (325, 345), (280, 310))
    ),
    *(
        (ZED.format(1), a, ZED.format(2), b)
        for a, b in ((5, 5), (20, 30), (40, 40), (50, 70), (70, 20), (80, 90), (10, 60), (75, 40))
    ),
    *(
        ("kitti/sequences/street1", a, "kitti/sequences/street1", b)
        for a, b in ((0, 1), (10, 12), (20, 23), (30, 32))
    ),
    *(
        ("kitti/sequences/street2", a, "kitti/sequences/street2", b)
        for a, b in ((0, 2), (10, 13), (20, 21), (40, 43))
    ),
]
NUM_FEATURES = 850
Extract = Callable[[np.ndarray], Features]


@dataclass(frozen=True)
class Args:
    shared: Path = Path(os.environ.get("TOPOLOC_SHARED", Path(__file__).parents[2] / "shared"))
    json: Path | None = None


@dataclass(frozen=True, eq=False)
class Pair:
    mapped: PreparedFrame
    queries: dict[str, np.ndarray]
    query_from_map: Rigid3


def darkened(image: np.ndarray, power: float, seed: int) -> np.ndarray:
    """A third of the light, falling off to a tenth at the right, a power curve, and a sensor's
    noise of 4 grey levels."""
    light = image / 255 / 3 * np.linspace(1.0, 0.3, image.shape[1])
    noise = np.random.default_rng(seed).normal(0, 4, image.shape)
    return np.clip(np.rint(255 * light**power + noise), 0, 255).astype(np.uint8)


def lamplit(image: np.ndarray, seed: int) -> np.ndarray:
    """A few round pools of light in the dark, one hard shadow across the picture, the same
    noise."""
    random = np.random.default_rng(seed)
    height, width = image.shape
    y, x = np.mgrid[:height, :width]
    light = np.full(image.shape, 0.08)
    for _ in range(4):
        cx, cy, sigma = (
            random.uniform(0, width),
            random.uniform(0, height),
            random.uniform(0.08, 0.25) * width,
        )
        light += random.uniform(0.2, 0.9) * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 2 / sigma**2)
    angle = random.uniform(0, 2 * np.pi)
    light *= np.where(
        np.cos(angle) * (x - width / 2) + np.sin(angle) * (y - height / 2) > 0, 1.0, 0.45
    )
    return np.clip(np.rint(image * light + random.normal(0, 4, image.shape)), 0, 255).astype(
        np.uint8
    )


def surf(
    normalization: PatchNormalizationConfig | None, threshold: float = 20.0, num: int = NUM_FEATURES
) -> Extract:
    return lambda image: extract_surf(
        image if normalization is None else patch_normalize(image, normalization), threshold, num
    )


def pooled(first: Extract, second: Extract) -> Extract:
    return lambda image: Features.concatenate([first(image), second(image)])


def reranked(window_px: int, epsilon: float) -> Extract:
    """Found and described in the raw picture, but the strongest by contrast relative to the
    surroundings are kept."""
    many = surf(None, threshold=2.0, num=4000)

    def extract(image: np.ndarray) -> Features:
        features = many(image)
        grey = image.astype(np.float32)
        mean = cv2.blur(grey, (window_px, window_px))
        sigma = np.sqrt(np.maximum(cv2.blur(grey * grey, (window_px, window_px)) - mean**2, 0))
        x, y = (
            np.clip(np.rint(features.points_img), 0, [grey.shape[1] - 1, grey.shape[0] - 1])
            .astype(int)
            .T
        )
        return features.select(
            np.argsort(-features.responses / (sigma[y, x] + epsilon) ** 2, kind="stable")[
                :NUM_FEATURES
            ]
        )

    return extract


def window(
    side: int, epsilon: float, shape: Literal["square", "round"] = "square"
) -> PatchNormalizationConfig:
    return PatchNormalizationConfig(side, epsilon, shape)


VARIANTS: dict[str, Extract] = {
    "raw, threshold 400": surf(None, 400.0),
    "raw": surf(None),
    "raw, ranked by local contrast": reranked(65, 8.0),
    "paper: 17 square, 0.001": surf(PatchNormalizationConfig.paper()),
    "17 square, 8": surf(window(17, 8.0)),
    "17 round, 8": surf(window(17, 8.0, "round")),
    "33 square, 0.001": surf(window(33, 1e-3)),
    "33 square, 16": surf(window(33, 16.0)),
    "33 round, 16": surf(window(33, 16.0, "round")),
    "65 square, 8": surf(window(65, 8.0)),
    "65 square, 24 (wide)": surf(window(65, 24.0)),
    "101 square, 16": surf(window(101, 16.0)),
    "half raw, half 33 square, 16": pooled(
        surf(None, num=NUM_FEATURES // 2), surf(window(33, 16.0), num=NUM_FEATURES // 2)
    ),
}


def make_pair(args: Args, number: int) -> Pair:
    map_path, map_idx, query_path, query_idx = PAIRS[number]
    mapped = prepare_frame(open_sequence(args.shared / "data" / map_path)[map_idx])
    query = prepare_frame(
        open_sequence(args.shared / "data" / query_path)[query_idx], with_depth=False
    )
    config = FeatureConfig(kind="sift", normalization="none", max_features=3000)
    features_map, features_query = (extract_features(view.grey, config) for view in (mapped, query))
    points, points_img = matched(features_map, features_query, mapped)
    pose = estimate_absolute_pose(points_img, points, mapped.camera)
    assert pose is not None
    grey = query.grey
    queries = {
        "untouched": grey,
        "v^0.6": darkened(grey, 0.6, number),
        "v^(1/0.6)": darkened(grey, 1 / 0.6, number),
        "lamps": lamplit(grey, number),
    }
    return Pair(mapped, queries, pose.cam_from_world)


def matched(
    features_map: Features, features_query: Features, mapped: PreparedFrame
) -> tuple[np.ndarray, np.ndarray]:
    """Map points (metres, the map picture's camera frame) and the query's pixels that they are
    matched with."""
    located = locate_points(features_map, mapped)
    rows = np.flatnonzero(located.valid)
    matches = match_features(
        features_query.descriptors, features_map.descriptors[rows], MatchingConfig()
    )
    return located.points_cam[rows[matches.train_idx]], features_query.points_img[
        matches.query_idx
    ].astype(np.float64)


def judge(pair: Pair, features_map: Features, features_query: Features) -> tuple[int, int, bool]:
    """Right matches, all matches, and whether the pose from them is good (2 degrees, 5 cm or 2 % of
    the median depth)."""
    points, points_img = matched(features_map, features_query, pair.mapped)
    if len(points) < 6:
        return 0, len(points), False
    errors = np.linalg.norm(
        pair.mapped.camera.img_from_cam(pair.query_from_map.apply(points)) - points_img, axis=1
    )
    pose = estimate_absolute_pose(points_img, points, pair.mapped.camera, AbsolutePoseConfig())
    good = (
        pose is not None
        and rotation_error(pose.cam_from_world, pair.query_from_map) < np.deg2rad(2.0)
        and translation_error(pose.cam_from_world, pair.query_from_map)
        < max(0.05, 0.02 * float(np.median(points[:, 2])))
    )
    return int((errors < 3.0).sum()), len(points), good


def main(args: Args) -> None:
    pairs = [make_pair(args, number) for number in range(len(PAIRS))]
    print(f"{len(pairs)} pairs: geometric mean of right matches / precision / good poses")
    print(" " * 30, *(f"{light:>18s}" for light in pairs[0].queries))
    results: dict[str, dict[str, dict[str, float]]] = {}
    for name, extract in VARIANTS.items():
        of_map = [extract(pair.mapped.grey) for pair in pairs]
        for light in pairs[0].queries:
            judged = [
                judge(pair, features, extract(pair.queries[light]))
                for pair, features in zip(pairs, of_map, strict=True)
            ]
            right, total, good = np.array(judged).T
            mean = float(np.expm1(np.log1p(right).mean()))
            result = {
                "right_matches": mean,
                "precision": float(right.sum() / max(total.sum(), 1)),
                "good_poses": int(good.sum()),
            }
            results.setdefault(name, {})[light] = result
        cells = (
            f"{r['right_matches']:.0f} / {r['precision']:.2f} / {r['good_poses']}"
            for r in results[name].values()
        )
        print(f"{name:30s}", *(f"{cell:>18s}" for cell in cells), flush=True)
    if args.json is not None:
        args.json.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main(tyro.cli(Args))
