"""Open maps that were made to deceive, in child processes: how many crash, hang, show a traceback,
or take much memory?

    python benchmarks/fuzz_maps.py MAP PICTURE CAMERA.json --mutations 100000 --first-seed 0

A child opens 50 mutations (`tests/mapping/mutations.py`, `tests/mapping/opening.py`): it asks each
about the picture and looks at all its bytes. Every finding is printed with its seed; exit status 1
where there is any.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

from topoloc.recordings.image_io import read_image

TESTS = Path(__file__).parents[1] / "tests" / "mapping"
sys.path.insert(0, str(TESTS))
from mutations import mutate  # noqa: E402

BATCH, MAX_SECONDS, MAX_RSS_KB = 50, 5.0, 1_000_000


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("camera", type=Path)
    parser.add_argument("--mutations", type=int, default=1000)
    parser.add_argument("--first-seed", type=int, default=0)
    arguments = parser.parse_args()
    outcomes, findings, slowest, largest = Counter(), [], 0.0, 0
    with tempfile.TemporaryDirectory() as folder:
        picture = Path(folder) / "picture.npy"
        np.save(picture, read_image(arguments.picture))
        seeds = range(arguments.first_seed, arguments.first_seed + arguments.mutations)
        for start in range(0, len(seeds), BATCH):
            batch = seeds[start : start + BATCH]
            maps = [Path(folder) / f"{seed}.topo" for seed in batch]
            done = [
                mutate(arguments.map, path, seed) for seed, path in zip(batch, maps, strict=True)
            ]
            while maps:
                told, why = _open(picture, arguments.camera, maps)
                for row in told:
                    outcomes[" | ".join(text.split(":")[0][:40] for text in row["outcome"])] += 1
                    slowest, largest = max(slowest, row["seconds"]), max(largest, row["rss_kb"])
                    if row["seconds"] > MAX_SECONDS or row["rss_kb"] > MAX_RSS_KB:
                        findings.append(
                            f"{Path(row['map']).stem}: {row['seconds']:.1f} s, {row['rss_kb']} kB"
                        )
                if len(told) < len(maps):
                    seed = int(maps[len(told)].stem)
                    findings.append(f"{seed} ({done[batch.index(seed)]}): {why}")
                    print(findings[-1], flush=True)
                maps = maps[len(told) + 1 :]
            for seed in batch:
                (Path(folder) / f"{seed}.topo").unlink()
    for outcome, count in outcomes.most_common():
        print(f"{count:7d}  {outcome}")
    print(
        f"{sum(outcomes.values())} mutations, {len(findings)} findings, slowest {slowest:.1f} s,"
        f" largest {largest / 1e3:.0f} MB"
    )
    print("\n".join(findings))
    return 1 if findings else 0


def _open(picture: Path, camera: Path, maps: list[Path]) -> tuple[list[dict], str]:
    """What a child said of each map until it ended, and why it ended."""
    command = [
        sys.executable,
        str(TESTS / "opening.py"),
        str(picture),
        str(camera),
        *map(str, maps),
    ]
    try:
        run = subprocess.run(
            command, capture_output=True, text=True, timeout=60.0 + 10.0 * len(maps), check=False
        )
    except subprocess.TimeoutExpired as error:
        output = error.stdout or b""
        return [
            json.loads(line)
            for line in (output.decode() if isinstance(output, bytes) else output).splitlines()
        ], "hangs"
    return [
        json.loads(line) for line in run.stdout.splitlines()
    ], f"exit {run.returncode}: {run.stderr.strip()[-400:]}"


if __name__ == "__main__":
    sys.exit(main())
