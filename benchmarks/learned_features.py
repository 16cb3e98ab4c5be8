"""Local features side by side where light changes: pairs of pictures of rendered places (exact
truth) and of a path by day and by night.

    python benchmarks/learned_features.py --kinds surf xfeat topoloc-net --pairs DAY,OTHER
    [--features N] [--shared ../shared]

DAY is a stereo recording, OTHER any other, both with truth; parts of one
(`street1@0::2,street1@1::2`) do as well. Each picture of OTHER is matched to the nearest one of DAY
that looks the same way (mutual nearest neighbours, no ratio), the day's points get their depth by
block matching, one PnP follows. Real pictures: frame i of the night walk of `gardenspoint` against
the day's frame i and against those from elsewhere, inliers of a fundamental matrix.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import poselib
import tyro

from topoloc.features.features import Features
from topoloc.features.learned import extract_learned
from topoloc.features.surf import extract_surf
from topoloc.recordings.frame import StereoFrame, to_grey
from topoloc.recordings.image_io import read_image
from topoloc.recordings.open import open_sequence

_TURN = np.cos(np.deg2rad(25))
_SOLVED = (0.10, 1.0)  # metres, degrees
_RIGHT_PX = 3.0
_APART = 10  # frames of the walk that are another place
_SIZES = {"edgepoint2-t32": 32, "edgepoint2-s32": 32}


@dataclass(frozen=True)
class Args:
    kinds: tuple[str, ...] = (
        "surf",
        "xfeat",
        "edgepoint2-t32",
        "edgepoint2-s64",
        "edgepoint2-e64",
        "topoloc-net",
    )
    pairs: tuple[str, ...] = ()
    shared: Path = Path(os.environ.get("TOPOLOC_SHARED", Path(__file__).parents[2] / "shared"))
    reach: float = 2.0
    """Metres from a picture to the day's that it is matched to, at most."""
    every: int = 1
    """Of the rendered pictures."""
    walk_step: int = 5
    features: int = 1000


def extract(image: np.ndarray, kind: str, count: int) -> Features:
    if kind == "surf":
        return extract_surf(image, max_features=count)
    return extract_learned(image, kind, _SIZES.get(kind, 64), count)


def match(first: Features, second: Features) -> tuple[np.ndarray, np.ndarray]:
    """Mutual nearest neighbours."""
    likes = first.descriptors @ second.descriptors.T
    there, back = likes.argmax(1), likes.argmax(0)
    rows = np.flatnonzero(back[there] == np.arange(len(there)))
    return rows, there[rows]


def disparity_map(frame: StereoFrame) -> np.ndarray:
    """Return the disparity (pixels) of the left image, below 1 if block matching finds none."""
    matcher = cv2.StereoSGBM.create(
        0,
        64,
        5,
        200,
        800,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=80,
        speckleRange=2,
    )
    return matcher.compute(to_grey(frame.image), to_grey(frame.right)).astype(np.float64) / 16


def day_points(frame: StereoFrame, disparity: np.ndarray, points_img: np.ndarray) -> np.ndarray:
    """Return points in the left camera, metres, NaN without depth."""
    x, y = np.round(points_img).astype(int).T
    z = np.where(
        disparity[y, x] > 1,
        frame.camera.fx * frame.rig.baseline / np.maximum(disparity[y, x], 1e-6),
        np.nan,
    )
    return np.column_stack([frame.camera.normalized_from_img(points_img) * z[:, None], z])


def rendered(names: str, args: Args) -> None:
    day_folder, _, other_folder = names.partition(",")
    days, others = open_sequence(day_folder), open_sequence(other_folder)
    day_poses = np.array([pose.matrix() for pose in days.poses])
    outcomes: dict[str, list[tuple[int, int, float, float]]] = {kind: [] for kind in args.kinds}
    for j in range(0, len(others), args.every):
        frame = others[j]
        pose = frame.world_from_cam.matrix()
        distance = np.linalg.norm(day_poses[:, :3, 3] - pose[:3, 3], axis=1)
        distance[day_poses[:, :3, 2] @ pose[:3, 2] < _TURN] = np.inf
        nearest = int(distance.argmin())
        if distance[nearest] > args.reach:
            continue
        day = days[nearest]
        disparity = disparity_map(day)
        other_from_day = np.linalg.inv(pose) @ day_poses[nearest]
        for kind in args.kinds:
            sets = [extract(to_grey(each.image), kind, args.features) for each in (day, frame)]
            outcomes[kind].append(ask(day, disparity, frame, other_from_day, sets))
    if not outcomes[args.kinds[0]]:
        print(f"{names}: no two pictures within {args.reach:g} m")
        return
    print(f"{names}: {len(outcomes[args.kinds[0]])} pictures; solved within 10 cm and 1 deg")
    for kind, rows in outcomes.items():
        matches, right, metres, degrees = np.array(rows).T
        solved = np.mean((metres <= _SOLVED[0]) & (degrees <= _SOLVED[1]))
        share = right.sum() / max(1, matches.sum())
        print(
            f"  {kind:16} solved {solved:6.1%}  median {100 * np.median(metres):6.2f} cm"
            f" {np.median(degrees):5.2f} deg  ",
            end="",
        )
        print(f"right matches {np.median(right):4.0f} of {np.median(matches):4.0f} ({share:.0%})")


def ask(
    day: StereoFrame,
    disparity: np.ndarray,
    other: StereoFrame,
    other_from_day: np.ndarray,
    sets: list[Features],
) -> tuple[int, int, float, float]:
    """Matches with depth, those of them that are right, and the errors of one PnP (m, deg)."""
    here, there = sets
    rows, columns = match(here, there)
    points = day_points(day, disparity, here.points_img[rows])
    known = np.isfinite(points[:, 2])
    points, pixels = points[known], there.points_img[columns][known].astype(np.float64)
    local = points @ other_from_day[:3, :3].T + other_from_day[:3, 3]
    expected = other.camera.img_from_cam(local)
    right = int((np.linalg.norm(expected - pixels, axis=1) < _RIGHT_PX).sum())
    camera = {
        "model": "PINHOLE",
        "width": other.camera.width,
        "height": other.camera.height,
        "params": list(other.camera.params),
    }
    if len(points) < 4:
        return len(points), right, np.inf, np.inf
    pose, _ = poselib.estimate_absolute_pose(pixels, points, camera, {"max_reproj_error": 3.0}, {})
    rotation = pose.R @ other_from_day[:3, :3].T
    metres = np.linalg.norm(pose.R.T @ pose.t - other_from_day[:3, :3].T @ other_from_day[:3, 3])
    return (
        len(points),
        right,
        float(metres),
        float(np.rad2deg(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1)))),
    )


def walked(folder: Path, args: Args) -> None:
    """The night walk against the day's on the same side of the path, and on the other side."""
    frames = range(0, 101 - args.walk_step, args.walk_step)
    apart = np.abs(np.subtract.outer(frames, frames)) >= _APART
    for kind in args.kinds:
        sets = {
            walk: [
                extract(
                    to_grey(read_image(folder / walk / f"Image{i:03}.jpg")), kind, args.features
                )
                for i in frames
            ]
            for walk in ("day_right", "day_left", "night_right")
        }
        for walk in ("day_right", "day_left"):
            counts = np.array(
                [[inliers(day, night) for night in sets["night_right"]] for day in sets[walk]]
            )
            best_other, same = np.where(apart, counts, 0).max(0), np.diag(counts)
            told = int((same > best_other).sum())
            middles = (
                f"inliers same place {np.median(same):4.0f}, best other"
                f" {np.median(best_other):4.0f}"
            )
            print(
                f"{walk} against night_right: {kind:16} told apart (more inliers than any other"
                f" place) {told:2} of {len(frames)}  {middles}"
            )


def inliers(day: Features, night: Features) -> int:
    rows, columns = match(day, night)
    if len(rows) < 8:
        return 0
    _, mask = cv2.findFundamentalMat(
        day.points_img[rows], night.points_img[columns], cv2.USAC_MAGSAC, 2.0, 0.999, 2000
    )
    return 0 if mask is None else int(mask.sum())


def main(args: Args) -> None:
    for names in args.pairs:
        rendered(names, args)
    walk = args.shared / "data" / "gardenspoint"
    if walk.is_dir():
        walked(walk, args)


if __name__ == "__main__":
    main(tyro.cli(Args))
