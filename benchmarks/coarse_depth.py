"""Maps from depth images as a phone's lidar gives them, beside maps from exact depth of the same
recording.

    python benchmarks/coarse_depth.py NAME=MAP_SEQ,QUERY_SEQ ... [--size 192x144] [--out DIR]

MAP_SEQ is an RGB-D folder with exact depth, as `topoloc simulate WORLD OUT --mono --depth` makes
it. The lidar measures a dot in every fourth cell (`--dots`) of the small image, the mean depth of
its cell with 1 % of noise (`--noise`). Cells between dots are interpolated, so edges are smeared.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from topoloc import TopoMetricMap
from topoloc.recordings.open import open_sequence

_UNITS = 1000.0
"""Units per metre of a phone's depth images."""


@dataclass(frozen=True)
class Lidar:
    """The size of its images, their pixels from dot to dot, and the noise of a dot, of its
    depth."""

    width: int
    height: int
    dots: int = 4
    noise: float = 0.01
    seed: int = 0


def lidar_depth(
    depth: Float[np.ndarray, "h w"], lidar: Lidar, index: int
) -> Float[np.ndarray, "a b"]:
    """Return exact depth as a lidar sees it in image `index`."""
    size, dots = (lidar.width, lidar.height), lidar.dots
    known = np.isfinite(depth)
    sums = (
        cv2.resize(part.astype(np.float64), size, interpolation=cv2.INTER_AREA)
        for part in (np.where(known, depth, 0.0), known)
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        total, share = sums
        cells = np.where(share > 0.5, total / share, np.nan)
    start = dots // 2
    measured = cells[start::dots, start::dots]
    rng = np.random.default_rng([lidar.seed, index])
    measured = measured * (1.0 + lidar.noise * rng.standard_normal(measured.shape))
    x, y = (
        ((np.arange(length) - start) / dots).astype(np.float32).clip(0, count - 1)
        for length, count in zip(size, measured.shape[::-1], strict=True)
    )
    return cv2.remap(measured.astype(np.float32), *np.meshgrid(x, y), cv2.INTER_LINEAR)


def write_coarse(source: Path, folder: Path, lidar: Lidar) -> Path:
    """Write the recording with the depth of a lidar. Its images are links."""
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "depth").mkdir(parents=True)
    os.symlink((source / "rgb").resolve(), folder / "rgb")
    for name in ("times.txt", "truth.tum"):
        shutil.copy(source / name, folder / name)
    facts = json.loads((source / "camera.json").read_text())
    (folder / "camera.json").write_text(json.dumps(facts | {"depth_factor": _UNITS}))
    sequence = open_sequence(source)
    for index, name in enumerate(sequence.names):
        image = sequence[index].depth
        assert image is not None
        coarse = _UNITS * lidar_depth(image.depth, lidar, index)
        stored = np.rint(np.nan_to_num(coarse)).clip(0, 65534).astype(np.uint16)
        cv2.imwrite(str(folder / "depth" / f"{Path(name).stem}.png"), stored)
    return folder


def _topoloc(*arguments: str) -> None:
    subprocess.run(
        [sys.executable, "-m", "topoloc", *arguments], check=True, stdout=subprocess.DEVNULL
    )


def measure_points(map_path: Path, source: Path) -> list[str]:
    """Return, for ranges of depth, the errors of the points' depths against exact depth."""
    sequence, found = open_sequence(source), []
    rows = {name: row for row, name in enumerate(sequence.names)}
    for node in TopoMetricMap.load(map_path).nodes:
        image = sequence[rows[node.summary.name]].depth
        assert image is not None
        columns, lines = np.rint(node.features.points_img).astype(int).T
        # Beside an edge the depth of a feature is not that of its pixel.
        nearest, farthest = (
            function(image.depth, np.ones((5, 5))) for function in (cv2.erode, cv2.dilate)
        )
        is_plain = farthest - nearest < 0.05 * nearest
        truth = np.where(is_plain, image.depth, np.nan)[lines, columns]
        sigmas = np.linalg.norm(node.point_sqrt_covs[:, 3:], axis=1)
        found.append(np.column_stack([truth, np.abs(node.points_cam[:, 2] - truth), sigmas]))
    truth, errors, sigmas = np.concatenate(found).T
    result = []
    for low, high in ((0, 1), (1, 2), (2, 3), (3, 5), (5, 100)):
        rows = (truth >= low) & (truth < high)
        if rows.any():
            off = 100 * np.median(errors[rows] / truth[rows])
            normalized = errors[rows] / sigmas[rows]
            result.append(
                f"    {low} to {high} m: {rows.sum()} points, {off:.2f} % off in the median,"
                f" normalized {np.median(normalized) / 0.6745:.2f},"
                f" {100 * (normalized < 2).mean():.0f} % within two sigmas"
            )
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pairs", nargs="+", metavar="NAME=MAP_SEQ,QUERY_SEQ")
    parser.add_argument("--size", default="192x144")
    parser.add_argument("--dots", type=int, default=4)
    parser.add_argument("--noise", type=float, default=0.01)
    parser.add_argument("--seed", type=int, default=0, help="of the noise")
    parser.add_argument("--features", default="surf")
    parser.add_argument("--out", type=Path, default=Path("out/coarse_depth"))
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    lidar = Lidar(width, height, options.dots, options.noise, options.seed)
    options.out.mkdir(parents=True, exist_ok=True)
    for pair in options.pairs:
        name, _, both = pair.partition("=")
        source, queries = both.split(",")
        coarse, medians = write_coarse(Path(source), options.out / name, lidar), []
        for kind, recording in (("exact", source), ("coarse", str(coarse))):
            target, facts = (options.out / f"{name}_{kind}.{end}" for end in ("topo", "json"))
            _topoloc("build", recording, str(target), "--features", options.features)
            _topoloc("evaluate", str(target), queries, "--json", str(facts))
            found = json.loads(facts.read_text())
            medians.append(100 * found["median_translation_m"])
            print(
                f"{name}, {kind} depth: {found['num_localized']} of {found['num_queries']},"
                f" {medians[-1]:.3f} cm, {found['median_rotation_deg']:.3f} deg, at most"
                f" {100 * found['max_translation_m']:.1f} cm, {found['num_inaccurate']} inaccurate,"
                f" {found['num_outside_ellipsoid']} outside their ellipsoid",
                *measure_points(target, Path(source)),
                sep="\n",
                flush=True,
            )
        print(f"{name}: {medians[1] / medians[0]:.2f} times the error", flush=True)


if __name__ == "__main__":
    main()
