"""Measure what the last step of a query changes: each image localized with `exactness="fast"` and
`"best"` in the same map, beside exact truth.

    python benchmarks/exactness.py MAP_SEQ QUERY_SEQ [QUERY_SEQ ...] [--every N]
        [--map-from-truth FILE] [--min-probability P] [--max-degrees D] [--json FILE]
    python benchmarks/exactness.py MAP_SEQ QUERY_SEQ ... --vary num_nodes=6,12,24 ...

Recordings as by `topoloc simulate`, or any with truth in the same world, else FILE says where that
of the queries lies in that of the map. MAP_SEQ may be a map file. `error/sigma` is the median error
over the root of the covariance's trace: 0.89 if the covariance is exact. `inside` counts poses
within their 95 % ellipsoid, `TOO FEW` if that is significantly (5 %) below 95 %. `wrong`: beyond
0.25 m or D degrees (default 2). Last, all recordings together. `--vary` prints a row for each value
of a number of `exact/weights.json` (JSON, such as `max_errors_px=[8,3],[8,4]` or
`max_aligned=500,1000`), while the others stay.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from scipy.stats import binom

from topoloc.geometry.rigid import Rigid3
from topoloc.localization.exact import last_step
from topoloc.localization.exact.patch_alignment import load_last_step_weights
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.result import Localization
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.open import open_sequence
from topoloc_paper.fit.corpus import read_rigid

CHI_SQUARE_6_AT_95 = 12.592
Figures = dict[str, float]
Row = tuple[float, ...]
"""Metres, degrees, squared error in sigmas, error over sigma, milliseconds."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("mapped")
    parser.add_argument("queries", nargs="+")
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--map-from-truth", type=Path)
    parser.add_argument("--min-probability", type=float, help="instead of the map's")
    parser.add_argument("--max-degrees", type=float, default=2.0, help="of a right pose")
    parser.add_argument("--json", type=Path, help="write the figures of each row to this file")
    parser.add_argument("--vary", nargs="+", default=[], metavar="NAME=VALUES")
    arguments = parser.parse_args()
    is_file = arguments.mapped.endswith(".topo")
    topomap = (
        TopoMetricMap.load(arguments.mapped)
        if is_file
        else build_map(open_sequence(arguments.mapped))
    )
    fast, best = (
        Localizer(topomap, configure(name, arguments.min_probability)) for name in ("fast", "best")
    )
    found: dict[str, list[Row]] = {}
    figures: dict[str, Figures] = {}
    file = arguments.map_from_truth
    map_from_truth = read_rigid(file) if file else Rigid3.identity()
    for recording in arguments.queries:
        name = Path(recording).name
        asked = recording, arguments.every, map_from_truth, arguments.max_degrees, figures
        if not arguments.vary:
            row = print_row(f"{name}, fast", fast, *asked)
            found.setdefault("fast", []).extend(row)
        for label in vary_weights(arguments.vary):
            row = print_row(f"{name}, {label}", best, *asked)
            found.setdefault(label, []).extend(row)
    for label, rows in found.items():
        print(f"{'all, ' + label:40} {describe_inside(np.array([row[2] for row in rows]))}")
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=1))


def configure(exactness: Literal["fast", "best"], min_probability: float | None) -> LocalizerConfig:
    """Return the settings, with another least probability of an answer if one is given."""
    config = LocalizerConfig(exactness=exactness)
    if min_probability is None:
        return config
    return replace(config, evidence=replace(config.evidence, min_probability=min_probability))


def vary_weights(changes: list[str]) -> Iterator[str]:
    """Yield "best", then each changed number, while the last step uses it."""
    yield "best"
    for change in changes:
        name, _, text = change.partition("=")
        for value in json.loads(f"[{text}]"):
            numbers = msgspec.to_builtins(load_last_step_weights())
            set_number(numbers, name.split("."), value)
            changed = msgspec.convert(numbers, type(load_last_step_weights()))
            last_step.load_last_step_weights = lambda changed=changed: changed
            yield f"{name}={json.dumps(value)}"
    last_step.load_last_step_weights = load_last_step_weights


def set_number(numbers: dict[str, Any], path: list[str], value: Any) -> None:
    """Set the number at a path of names. Raises SystemExit: there is no such number."""
    for name in path[:-1]:
        numbers = numbers.get(name, {})
    if path[-1] not in numbers:
        raise SystemExit(f"exact/weights.json has no number {'.'.join(path)}")
    numbers[path[-1]] = value


def describe_inside(squares: np.ndarray) -> str:
    num_inside, num = int(np.count_nonzero(squares < CHI_SQUARE_6_AT_95)), len(squares)
    is_low = num > 0 and binom.cdf(num_inside, num, 0.95) < 0.05
    return f"inside {num_inside} of {num}" + (", TOO FEW" if is_low else "")


def print_row(
    name: str,
    localizer: Localizer,
    recording: str,
    every: int,
    map_from_truth: Rigid3,
    max_degrees: float,
    figures: dict[str, Figures],
) -> list[Row]:
    """Localize a recording, print its row, and add its figures."""
    sequence = open_sequence(recording)
    rows, asked = list[Row](), range(0, len(sequence), every)
    for index in asked:
        frame = sequence[index]
        start = time.process_time()
        found = localizer.localize(frame.image, frame.camera)
        milliseconds = 1e3 * (time.process_time() - start)
        if isinstance(found, Localization) and frame.world_from_cam is not None:
            truth = map_from_truth @ frame.world_from_cam
            error = (found.world_from_cam.inverse() @ truth).log()
            square = float(error @ np.linalg.solve(found.camera_covariance, error))
            metres = float(np.linalg.norm(error[:3]))
            degrees = float(np.rad2deg(np.linalg.norm(error[3:])))
            rows.append((metres, degrees, square, metres / found.position_sigma_m, milliseconds))
    if not rows:
        print(f"{name:40} 0 of {len(asked)}")
        figures[name] = {"images": len(asked), "localized": 0, "wrong": 0}
        return rows
    metres, degrees, squares, ratios, milliseconds = np.array(rows).T
    num_wrong = np.count_nonzero((metres > 0.25) | (degrees > max_degrees))
    figures[name] = {
        "images": len(asked),
        "localized": len(rows),
        "wrong": int(num_wrong),
        "median_cm": 100 * float(np.median(metres)),
        "median_deg": float(np.median(degrees)),
        "p90_cm": 100 * float(np.percentile(metres, 90)),
        "inside": int(np.count_nonzero(squares < CHI_SQUARE_6_AT_95)),
    }
    print(
        f"{name:40} {len(rows)} of {len(asked)}, {num_wrong} wrong, median"
        f" {100 * np.median(metres):.3f} cm {np.median(degrees):.3f} deg,"
        f" 90 % {100 * np.percentile(metres, 90):.2f} cm, max {100 * metres.max():.1f} cm,"
        f" {describe_inside(squares)}, error/sigma {np.median(ratios):.2f},"
        f" {np.median(milliseconds):.0f} ms of the processor",
        flush=True,
    )
    return rows


if __name__ == "__main__":
    main()
