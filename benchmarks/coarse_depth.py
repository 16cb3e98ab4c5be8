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
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from topoloc import TopoMetricMap
from topoloc.recordings.open import open_sequence

_UNITS = 1000.0
"""Units per metre of a phone's depth images."""


def lidar_depth(
    depth: Float[np.ndarray, "h w"], size: tuple[int, int], dots: int, noise: float, seed: int
) -> Float[np.ndarray, "a b"]:
    """Return exact depth as a lidar sees it, of width and height `size`."""
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
    measured = measured * (
        1.0 + noise * np.random.default_rng(seed).standard_normal(measured.shape)
    )
    x, y = (
        ((np.arange(length) - start) / dots).astype(np.float32).clip(0, count - 1)
        for length, count in zip(size, measured.shape[::-1], strict=True)
    )
    return cv2.remap(measured.astype(np.float32), *np.meshgrid(x, y), cv2.INTER_LINEAR)


def write_coarse(
    source: Path, folder: Path, size: tuple[int, int], dots: int, noise: float, seed: int
) -> Path:
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
        coarse = _UNITS * lidar_depth(image.depth, size, dots, noise, 10_000 * seed + index)
        stored = np.rint(np.nan_to_num(coarse)).clip(0, 65534).astype(np.uint16)
        cv2.imwrite(str(folder / "depth" / f"{Path(name).stem}.png"), stored)
    return folder


def _topoloc(*arguments: str) -> None:
    subprocess.run(
        [sys.executable, "-m", "topoloc", *arguments], check=True, stdout=subprocess.DEVNULL
    )


def measure_points(map_path: Path, source: Path) -> dict[str, list[float]]:
    """Return what the points' depths are off by against exact depth, by range: relative error
    (median of absolute values), and share within two standard deviations."""
    sequence, found = open_sequence(source), []
    rows = {name: row for row, name in enumerate(sequence.names)}
    for node in TopoMetricMap.load(map_path).nodes:
        image = sequence[rows[node.summary.name]].depth
        assert image is not None
        columns, lines = np.rint(node.features.points_img).astype(int).T
        height, width = image.depth.shape
        # Beside an edge the depth of a feature is not that of its pixel.
        nearest, farthest = (
            function(image.depth, np.ones((5, 5))) for function in (cv2.erode, cv2.dilate)
        )
        exact = np.where(farthest < 1.05 * nearest, image.depth, np.nan)
        truth = exact[lines.clip(0, height - 1), columns.clip(0, width - 1)]
        roots = np.zeros((len(truth), 3, 3))
        roots[:, *np.tril_indices(3)] = node.point_sqrt_covs
        sigmas = np.sqrt((roots[:, 2] ** 2).sum(axis=1))
        found.append(np.column_stack([truth, node.points_cam[:, 2] - truth, sigmas]))
    truth, errors, sigmas = np.concatenate(found).T
    result = {}
    for low, high in ((1, 2), (2, 3), (3, 5), (5, 10)):
        rows = (truth >= low) & (truth < high)
        if rows.any():
            relative = np.abs(errors[rows]) / truth[rows]
            normalized = np.abs(errors[rows]) / sigmas[rows]
            result[f"{low}-{high}"] = [
                int(rows.sum()),
                100 * float(np.median(relative)),
                100 * float((relative > 0.05).mean()),
                float(np.median(normalized) / 0.6745),
                100 * float((normalized < 2).mean()),
            ]
    return result


def _print(name: str, kind: str, found: dict, points: dict) -> None:
    print(
        f"{name} {kind}: {found['num_localized']} of {found['num_queries']},"
        f" {100 * found['median_translation_m']:.3f} cm, {found['median_rotation_deg']:.3f} deg, worst"
        f" {100 * found['max_translation_m']:.1f} cm, inaccurate {found['num_inaccurate']}, outside"
        f" {found['num_outside_ellipsoid']}",
        flush=True,
    )
    for span, row in points.items():
        print(
            f"    {span} m: {row[0]} points, off by {row[1]:.2f} %, over 5 %: {row[2]:.1f} %,"
            f" normalized {row[3]:.2f}, within two sigmas {row[4]:.1f} %",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("pairs", nargs="+")
    parser.add_argument("--size", default="192x144")
    parser.add_argument("--dots", type=int, default=4)
    parser.add_argument("--noise", type=float, default=0.01)
    parser.add_argument("--features", default="surf")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/coarse_depth"))
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    options.out.mkdir(parents=True, exist_ok=True)
    for pair in options.pairs:
        name, _, both = pair.partition("=")
        source, queries = both.split(",")
        coarse = write_coarse(
            Path(source),
            options.out / f"{name}_{options.size}",
            (width, height),
            options.dots,
            options.noise,
            options.seed,
        )
        for kind, recording in (("full", source), ("coarse", str(coarse))):
            target = options.out / f"{name}_{kind}.topo"
            facts = options.out / f"{name}_{kind}.json"
            _topoloc("build", recording, str(target), "--features", options.features)
            _topoloc("evaluate", str(target), queries, "--json", str(facts))
            _print(name, kind, json.loads(facts.read_text()), measure_points(target, Path(source)))


if __name__ == "__main__":
    main()
