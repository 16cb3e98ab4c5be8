"""An honest "not here": pictures of other places are shown to a map, and what speaks for and
against each answer is printed.

    python examples/reject_elsewhere.py [MAP SEQ ...]

Without arguments the built-in lab is asked about itself by day and by night, about a corridor and
about a street.
"""

import argparse
from collections import Counter
from pathlib import Path

import numpy as np

import topoloc
from topoloc.demo.recordings import SHIPPED

ASKED = ("day@0::4", "night@0::4", "corridor", "street")


def main(map_file: Path | None, recordings: list[str]) -> None:
    if map_file is None:
        topomap = topoloc.build_map(
            [topoloc.open_sequence(SHIPPED / name) for name in ("map_lap1", "map_lap2")]
        )
    else:
        topomap = topoloc.TopoMetricMap.load(map_file)
    localizer = topoloc.Localizer(topomap)
    print(
        f"a pose is reported from a probability of {localizer.config.evidence.min_probability} on"
    )
    for path in recordings:
        pictures = topoloc.open_sequence(path)
        results = [
            localizer.localize(pictures[i].image, pictures[i].camera) for i in range(len(pictures))
        ]
        accepted = [result for result in results if isinstance(result, topoloc.Localization)]
        reasons = Counter(
            result.reason for result in results if isinstance(result, topoloc.NotLocalized)
        )
        print(
            f"{Path(path).name}: {len(accepted)} of {len(results)} accepted; refused:"
            f" {dict(reasons) or 'none'}"
        )
        print(f"    inliers, median: {np.median([result.num_inliers for result in results]):.0f}")
        if accepted:
            weakest = min(accepted, key=lambda result: result.probability)
            print(
                f"    least certain pose: probability {weakest.probability:.3f}, {weakest.evidence}"
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("map", nargs="?", type=Path, help="a map file")
    parser.add_argument(
        "recordings",
        nargs="*",
        default=[str(SHIPPED / name) for name in ASKED],
        help="pictures from anywhere",
    )
    args = parser.parse_args()
    main(args.map, args.recordings)
