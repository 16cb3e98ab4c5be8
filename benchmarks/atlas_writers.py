"""Writers of one atlas at once, each a process of its own: is every tile there afterwards, and the
manifest whole?

    python benchmarks/atlas_writers.py MAP [--writers 2] [--times 50] [--s3]

Each writer adds so many tiles, one at a time, with the command's own code; the map is the same for
all, under ids of their own. The atlas is a folder; with `--s3` a prefix of moto's server, which
speaks the API of Amazon S3 on this machine (obstore, 'moto[s3]', flask, flask-cors).
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path

import httpx

from topoloc.atlas.atlas import Atlas
from topoloc.atlas.editing import add_tiles, create_atlas, new_tiles


def write(where: str, path: str, writer: int, times: int) -> None:
    for number in range(times):
        add_tiles(where, new_tiles([path], f"w{writer}-{number}"))


@contextmanager
def place(folder: str, is_s3: bool) -> Iterator[str]:
    """Yield the place of the atlas: a folder, or a prefix of a local S3 server."""
    if not is_s3:
        yield str(Path(folder) / "atlas")
        return
    from moto.server import ThreadedMotoServer  # pyright: ignore[reportMissingImports]

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    address = "http://{}:{}".format(*server.get_host_and_port())
    os.environ.update(
        AWS_ENDPOINT_URL=address,
        AWS_DEFAULT_REGION="us-east-1",
        AWS_ACCESS_KEY_ID="x",
        AWS_SECRET_ACCESS_KEY="x",
    )
    os.environ["TOPOLOC_CACHE"] = folder
    httpx.put(f"{address}/bucket").raise_for_status()
    yield "s3://bucket/atlas"
    server.stop()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map")
    parser.add_argument("--writers", type=int, default=2)
    parser.add_argument("--times", type=int, default=50)
    parser.add_argument("--s3", action="store_true")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, place(folder, args.s3) as where:
        create_atlas(where, [])
        start = time.perf_counter()
        with ProcessPoolExecutor(args.writers, get_context("spawn")) as pool:
            for done in [
                pool.submit(write, where, args.map, writer, args.times)
                for writer in range(args.writers)
            ]:
                done.result()
        atlas = Atlas.open(where)
        expected = {
            f"w{writer}-{number}" for writer in range(args.writers) for number in range(args.times)
        }
        missing = expected - {tile.tile_id for tile in atlas.manifest.tiles}
        damaged = [
            problem
            for tile in atlas.manifest.tiles
            if (problem := atlas.find_problem(tile.tile_id))
        ]
        print(
            f"{args.writers} writers, {args.times} tiles each, {time.perf_counter() - start:.0f} s:"
            f" {len(missing)} missing, {len(damaged)} damaged, serial {atlas.manifest.serial}"
        )


if __name__ == "__main__":
    main()
