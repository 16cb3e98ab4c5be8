"""Compare files of one network on hard pairs of images: looking aside, other light, real images.

    python benchmarks/network_pairs.py FOLDER [FOLDER ...] [--views VIEWS] [--shared ../shared]

Each FOLDER holds a `topoloc-net.onnx`. Mutual nearest neighbours of 1,000 key points are matched.
VIEWS are rendered by `python -m topoloc_worlds.wide_views`: depth and poses say whether a
match is right (within 3 px). Real recordings: within 2 px of the epipolar line of the true poses,
as they are and darkened. `gardenspoint`: a day's walk and a night's.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path

import cv2
import numpy as np

from topoloc.features import network_files
from topoloc.features.features import Features
from topoloc.features.learned import close_networks, extract_learned
from topoloc.geometry.camera import Camera
from topoloc.recordings.frame import to_grey
from topoloc.recordings.image_io import read_image
from topoloc.recordings.open import open_sequence
from topoloc_training.net.stored_depth import read_depth
from topoloc_worlds.wide_views import LIGHTS

FOCAL, CENTRE, SIZE = 380.0, np.array([319.5, 199.5]), np.array([640, 400])
RIGHT_PX, LINE_PX = 3.0, 2.0
ANGLES_DEG = (12.0, 30.0, 50.0, 75.0)
NAMES = ("ahead", "20 aside", "40 aside", "60 aside")
PAIRS_A_GROUP, DAY = 16, 0
REAL = {
    "kitchen": ("seven_scenes/kitchen/seq-01", 15, 20),
    "zed": ("zed_lab/session1", 6, 15),
    "kitti 1": ("kitti/sequences/street1", 3, 3),
    "kitti 2": ("kitti/sequences/street2", 3, 3),
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--views", type=Path)
    default = os.environ.get("TOPOLOC_SHARED", Path(__file__).parents[2] / "shared")
    parser.add_argument("--shared", type=Path, default=default)
    arguments = parser.parse_args()
    for folder in arguments.folders:
        network_files._BUNDLED_FOLDER = folder
        close_networks()
        print(folder, flush=True)
        if arguments.views:
            compare_views(arguments.views)
        compare_recordings(arguments.shared / "data")
        compare_walks(arguments.shared / "data" / "gardenspoint")


def match(first: Features, second: Features) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels (n, 2) of mutual nearest neighbours."""
    likes = first.descriptors @ second.descriptors.T
    there, back = likes.argmax(1), likes.argmax(0)
    rows = np.flatnonzero(back[there] == np.arange(len(there)))
    return first.points_img[rows].astype(float), second.points_img[there[rows]].astype(float)


def compare_views(folder: Path) -> None:
    """Print right matches and their share, for each angle, in the same and in other light."""
    rows: dict[tuple[str, str], list[tuple[int, int]]] = {}
    records = [r for r in json.loads((folder / "views.json").read_text()) if r["place"]]
    for place in sorted({record["place"] for record in records}):
        metas = [record for record in records if record["place"] == place]
        images = [cv2.imread(str(folder / record["file"]), 0) for record in metas]
        features = [extract_learned(image, "topoloc-net", 64) for image in images]
        depths = [inverse_of(read_depth(folder / record["depth"])) for record in metas]
        poses = np.array([record["world_from_cam"] for record in metas])
        for group, pairs in grouped(metas, poses, depths).items():
            step = max(1, len(pairs) // PAIRS_A_GROUP)
            for i, j in pairs[::step][:PAIRS_A_GROUP]:
                at, other = match(features[i], features[j])
                z = 1 / np.maximum(inverse_depth(depths[i], at), 1e-6)
                projected, _ = project(at, z, np.linalg.inv(poses[j]) @ poses[i])
                known = z < 1e5
                right = known & (np.linalg.norm(projected - other, axis=1) < RIGHT_PX)
                rows.setdefault(group, []).append((int(right.sum()), int(known.sum())))
    for (name, light), found in sorted(rows.items()):
        right, known = np.array(found).T
        print(
            f"  {name:9} {light:11} {len(found):3} pairs: {right.mean():6.1f} right,"
            f" {right.sum() / known.sum():5.1%}, at least 30: {np.mean(right >= 30):4.0%}",
            flush=True,
        )


def grouped(
    metas: list[dict], poses: np.ndarray, depths: list[np.ndarray]
) -> dict[tuple[str, str], list[tuple[int, int]]]:
    """Return pairs that share at least 5 % of the points of the first, by angle and light."""
    y, x = np.mgrid[1:400:16, 1:640:16]
    pixels = np.column_stack([x.ravel(), y.ravel()]).astype(float)
    groups: dict[tuple[str, str], list[tuple[int, int]]] = {}
    for i, first in enumerate(metas):
        z = 1 / np.maximum(inverse_depth(depths[i], pixels), 1e-6)
        for j, second in enumerate(metas):
            is_other = first["light"] != second["light"]
            if i == j or (is_other and first["light"] != DAY):
                continue
            angle = np.rad2deg(np.arccos(np.clip(poses[i][:3, 2] @ poses[j][:3, 2], -1, 1)))
            at, depth = project(pixels, z, np.linalg.inv(poses[j]) @ poses[i])
            seen = inverse_depth(depths[j], at) * depth
            shared = (np.abs(seen - 1) < 0.02) & ((at > 2) & (at < SIZE - 3)).all(1) & (z < 1e5)
            if shared.mean() < 0.05 or angle > ANGLES_DEG[-1]:
                continue
            name = NAMES[int(np.searchsorted(ANGLES_DEG, angle))]
            groups.setdefault(
                (name, LIGHTS[second["light"]] if is_other else "same light"), []
            ).append((i, j))
    return groups


def inverse_of(depth: np.ndarray) -> np.ndarray:
    """Return 1/m; 0 where there is no depth."""
    return np.where(depth > 0, 1 / np.maximum(depth, 1e-3), 0).astype(np.float32)


def inverse_depth(inverse: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    place = ((pixels - 1) / 4).astype(np.float32)
    return cv2.remap(inverse, place[:, None], None, cv2.INTER_LINEAR)[:, 0].astype(float)


def project(
    pixels: np.ndarray, z: np.ndarray, other_from_cam: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    points = np.column_stack([(pixels - CENTRE) / FOCAL * z[:, None], z])
    moved = points @ other_from_cam[:3, :3].T + other_from_cam[:3, 3]
    depth = np.where(moved[:, 2] > 0.05, moved[:, 2], np.inf)
    return moved[:, :2] / depth[:, None] * FOCAL + CENTRE, np.minimum(depth, 1e9)


def compare_recordings(data: Path) -> None:
    """Print matches near their epipolar line, by true poses, as it is and with a dark second."""
    for name, (path, step, apart) in REAL.items():
        if not (data / path).exists():
            continue
        sequence = open_sequence(str(data / path))
        for dark in (False, True):
            counts = []
            for i in range(0, len(sequence) - apart, step):
                first, second = sequence[i], sequence[i + apart]
                other = darkened(to_grey(second.image), i) if dark else to_grey(second.image)
                here, there = match(
                    extract_learned(to_grey(first.image), "topoloc-net", 64),
                    extract_learned(other, "topoloc-net", 64),
                )
                moved = second.world_from_cam.inverse() @ first.world_from_cam
                counts.append(num_near_line(here, there, moved.matrix(), first.camera))
            near, total = np.array(counts).T
            print(
                f"  {name:9} {'dark' if dark else 'as it is':11} {len(counts):3} pairs:"
                f" {near.mean():6.1f} near, {near.sum() / total.sum():5.1%}",
                flush=True,
            )


def darkened(image: np.ndarray, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, 4, image.shape)
    lit = 255 * (image / 255) ** 1.6 * np.linspace(0.4, 0.15, image.shape[1])
    return np.clip(lit + noise, 0, 255).astype(np.uint8)


def num_near_line(
    here: np.ndarray, there: np.ndarray, other_from_cam: np.ndarray, camera: Camera
) -> tuple[int, int]:
    x, y, z = other_from_cam[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    first, second = (
        np.column_stack([camera.normalized_from_img(px), np.ones(len(px))]) for px in (here, there)
    )
    lines = first @ (cross @ other_from_cam[:3, :3]).T
    distance = np.abs((lines * second).sum(1)) / np.linalg.norm(lines[:, :2], axis=1)
    return int((distance * camera.fx < LINE_PX).sum()), len(here)


def compare_walks(walks: Path) -> None:
    """Print inliers of a fundamental matrix at the same place, and how often they are the most."""
    if not walks.is_dir():
        return
    frames = range(0, 100, 8)
    sets = {
        walk: [
            extract_learned(
                to_grey(read_image(walks / walk / f"Image{i:03}.jpg")), "topoloc-net", 64
            )
            for i in frames
        ]
        for walk in ("day_right", "day_left", "night_right")
    }
    for walk in ("day_right", "day_left"):
        counts = np.array(
            [[num_inliers(night, day) for day in sets[walk]] for night in sets["night_right"]]
        )
        same, first = np.diag(counts), counts.argmax(1) == np.arange(len(counts))
        print(
            f"  {walk} against night_right: {same.mean():.1f} inliers (elsewhere"
            f" {(counts.sum() - same.sum()) / (counts.size - len(counts)):.1f}),"
            f" first {first.sum()} of {len(first)}",
            flush=True,
        )


def num_inliers(first: Features, second: Features) -> int:
    here, there = match(first, second)
    if len(here) < 8:
        return 0
    mask = cv2.findFundamentalMat(here, there, cv2.USAC_MAGSAC, 2.0, 0.999, 1000)[1]
    return 0 if mask is None else int(mask.sum())


if __name__ == "__main__":
    main()
