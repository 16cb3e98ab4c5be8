"""Measure what the last step of a query changes: each image localized with `exactness="fast"` and
`"best"` in the same map, beside exact truth.

    python benchmarks/exactness.py MAP_SEQ QUERY_SEQ [QUERY_SEQ ...] [--every N]

Recordings as by `topoloc simulate`, or any with truth in the same world. MAP_SEQ may be a map file.
`error/sigma` is the median error over the root of the covariance's trace: 0.89 if the covariance is
exact. `inside` is the share of poses within their 95 % ellipsoid.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.result import Localization
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.open import open_sequence

CHI_SQUARE_6_AT_95 = 12.592


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("mapped")
    parser.add_argument("queries", nargs="+")
    parser.add_argument("--every", type=int, default=1)
    arguments = parser.parse_args()
    is_file = arguments.mapped.endswith(".topo")
    topomap = (
        TopoMetricMap.load(arguments.mapped)
        if is_file
        else build_map(open_sequence(arguments.mapped))
    )
    localizers = {
        exactness: Localizer(topomap, LocalizerConfig(exactness=exactness))
        for exactness in ("fast", "best")
    }
    for recording in arguments.queries:
        for exactness, localizer in localizers.items():
            print_row(f"{Path(recording).name}, {exactness}", localizer, recording, arguments.every)


def print_row(name: str, localizer: Localizer, recording: str, every: int) -> None:
    sequence = open_sequence(recording)
    rows, asked = list[tuple[float, ...]](), range(0, len(sequence), every)
    for index in asked:
        frame = sequence[index]
        start = time.process_time()
        found = localizer.localize(frame.image, frame.camera)
        milliseconds = 1e3 * (time.process_time() - start)
        if isinstance(found, Localization):
            error = (found.world_from_cam.inverse() @ frame.world_from_cam).log()
            square = float(error @ np.linalg.solve(found.camera_covariance, error))
            metres = float(np.linalg.norm(error[:3]))
            degrees = float(np.rad2deg(np.linalg.norm(error[3:])))
            rows.append((metres, degrees, square, metres / found.position_sigma_m, milliseconds))
    if not rows:
        print(f"{name:32} 0 of {len(asked)}")
        return
    metres, degrees, squares, ratios, milliseconds = np.array(rows).T
    print(
        f"{name:32} {len(rows)} of {len(asked)}, median {100 * np.median(metres):.3f} cm"
        f" {np.median(degrees):.3f} deg, 90 % {100 * np.percentile(metres, 90):.2f} cm, max"
        f" {100 * metres.max():.1f} cm, inside {np.mean(squares < CHI_SQUARE_6_AT_95):.0%},"
        f" error/sigma {np.median(ratios):.2f}, {np.median(milliseconds):.0f} ms of the processor",
        flush=True,
    )


if __name__ == "__main__":
    main()
