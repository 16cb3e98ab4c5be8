"""Writers of one atlas at once, each a process of its own: is every tile there afterwards, and the manifest whole?

    python benchmarks/atlas_writers.py MAP [--writers 2] [--times 50]

Each writer adds so many tiles, one at a time, with the command's own code; the map is the same for all, under ids of their own.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from topoloc.atlas.atlas import Atlas, tile_problem
from topoloc.atlas.editing import add_tiles, create_atlas, new_tiles


def write(where: str, path: str, writer: int, times: int) -> None:
    for number in range(times):
        add_tiles(where, new_tiles([path], f"w{writer}-{number}"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("map")
    parser.add_argument("--writers", type=int, default=2)
    parser.add_argument("--times", type=int, default=50)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        where = str(Path(folder) / "atlas")
        create_atlas(where, [])
        start = time.perf_counter()
        with ProcessPoolExecutor(args.writers, get_context("spawn")) as pool:
            for done in [pool.submit(write, where, args.map, writer, args.times) for writer in range(args.writers)]:
                done.result()
        atlas = Atlas.open(where)
        expected = {f"w{writer}-{number}" for writer in range(args.writers) for number in range(args.times)}
        missing = expected - {tile.tile_id for tile in atlas.manifest.tiles}
        damaged = [problem for tile in atlas.manifest.tiles if (problem := tile_problem(atlas, tile))]
        print(
            f"{args.writers} writers, {args.times} tiles each, {time.perf_counter() - start:.0f} s: {len(missing)} missing, "
            f"{len(damaged)} damaged, serial {atlas.manifest.serial}"
        )


if __name__ == "__main__":
    main()
