"""Measure recall of the coarse search of a feature type under another light.

    python benchmarks/place_recall.py --kinds surf topoloc-net --pairs MAPPED,ASKED --reach 1
    [--walks day_right,night_right]

MAPPED and ASKED are recordings with truth (also parts of one, `street1@0::2`). surf-vlad of each
feature type is learned from all images of MAPPED, each of which is a node. Each image of ASKED is a
query, also without the network's cells (`VLAD alone`). A hit is a mapped image within `--reach`
metres and 20 degrees. Images of ASKED without such an image are left out. Walks are folders of
`gardenspoint`, in which images of equal numbers show the same place to within a frame or two. A hit
is the equal number, and, counted apart, one within two.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import tyro

from topoloc.features.extraction import extract_features
from topoloc.features.feature_types import FeatureConfig
from topoloc.features.features import Features
from topoloc.mapping.config import MapConfig
from topoloc.recordings.frame import to_grey
from topoloc.recordings.image_io import read_image
from topoloc.recordings.open import open_sequence
from topoloc.retrieval.vlad import SurfVlad, append_positions, learn_words, vlad

_TURN_DEG = 20.0
_NUM_FRAMES = 100
_WIDTH_PX = 640  # of the walks' pictures, which are larger
_FIRST = (1, 5, 16)


@dataclass(frozen=True)
class Args:
    kinds: tuple[str, ...] = ("surf", "topoloc-net")
    pairs: tuple[str, ...] = ()
    reach: float = 1.0
    walks: tuple[str, ...] = ("day_right,night_right", "day_left,night_right")
    every: int = 1
    """Of the pictures of ASKED."""
    shared: Path = Path(os.environ.get("TOPOLOC_SHARED", Path(__file__).parents[2] / "shared"))


Described = list[tuple[Features, np.ndarray]]
"""Features of pictures, each with an empty one of its size."""


def described(images: Iterator[np.ndarray], kind: str) -> Described:
    return [
        (extract_features(image, FeatureConfig(kind=kind)), np.empty_like(image))
        for image in images
    ]


def learnt(mapped: Described, kind: str) -> SurfVlad:
    """As `topoloc build` does, but for the words, which it learns from features with a 3-D position
    alone."""
    config = MapConfig().vlad_config_for(kind)
    found = [
        append_positions(features, image.shape[1], image.shape[0], config)
        for features, image in mapped
    ]
    words = learn_words(np.concatenate(found), config)
    vlads = np.stack([vlad(descriptors, words) for descriptors in found])
    return SurfVlad.fit(
        words, vlads, np.arange(len(mapped)), config, [features.cells for features, _ in mapped]
    )


def judge(
    mapped: Described, asked: Described, kind: str, hits: list[tuple[str, np.ndarray]]
) -> None:
    """Count right answers by name, with `hits` (asked, mapped)."""
    coarse = learnt(mapped, kind)
    ways = {
        "VLAD alone": [
            (features.select(np.arange(len(features))), image) for features, image in asked
        ]
    }
    if asked[0][0].cells is not None:
        ways["and cells"] = asked
    for way, queries in ways.items():
        times, ranked = [], []
        for features, image in queries:
            start = time.perf_counter()
            ranked.append([score.row for score in coarse.rank(image, features, max(_FIRST))])
            times.append(1e3 * (time.perf_counter() - start))
        for what, right in hits:
            found = np.array([right[k, row] for k, row in enumerate(ranked)])
            shares = "  ".join(f"@{n} {found[:, :n].any(axis=1).mean():.2f}" for n in _FIRST)
            print(
                f"  {kind:14} {way:10}  {what:12} {shares}  {np.median(times):.1f} ms", flush=True
            )


def recorded(names: str, args: Args) -> None:
    mapped, asked = (open_sequence(name) for name in names.split(","))
    here, there = (
        np.array([pose.matrix() for pose in sequence.poses if pose is not None])
        for sequence in (mapped, asked)
    )
    away = np.linalg.norm(there[:, None, :3, 3] - here[None, :, :3, 3], axis=2)
    right = (away <= args.reach) & (
        there[:, :3, 2] @ here[:, :3, 2].T >= np.cos(np.deg2rad(_TURN_DEG))
    )
    rows = np.flatnonzero(right.any(axis=1))[:: args.every]
    print(f"{names}: {len(rows)} asked")
    for kind in args.kinds:
        sets = [
            described((to_grey(sequence[int(k)].image) for k in which), kind)
            for sequence, which in ((mapped, range(len(mapped))), (asked, rows))
        ]
        judge(sets[0], sets[1], kind, [(f"{args.reach:g} m", right[rows])])


def walked(names: str, args: Args) -> None:
    apart = np.abs(np.subtract.outer(np.arange(_NUM_FRAMES), np.arange(_NUM_FRAMES)))
    print(f"{names}: {_NUM_FRAMES} asked")
    for kind in args.kinds:
        folders = [args.shared / "data" / "gardenspoint" / walk for walk in names.split(",")]
        sets = [
            described((reduced(folder, k) for k in range(_NUM_FRAMES)), kind) for folder in folders
        ]
        judge(sets[0], sets[1], kind, [("the frame", apart == 0), ("within two", apart <= 2)])


def reduced(folder: Path, k: int) -> np.ndarray:
    grey = to_grey(read_image(folder / f"Image{k:03}.jpg"))
    return cv2.resize(
        grey,
        (_WIDTH_PX, round(grey.shape[0] * _WIDTH_PX / grey.shape[1])),
        interpolation=cv2.INTER_AREA,
    )


def main(args: Args) -> None:
    for names in args.pairs:
        recorded(names, args)
    for names in args.walks if (args.shared / "data" / "gardenspoint").is_dir() else ():
        walked(names, args)


if __name__ == "__main__":
    main(tyro.cli(Args))
