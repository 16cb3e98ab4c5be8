"""Measure and draw the coarse search of an atlas over the number of places: time, recall of exact
search, memory, bytes, similar places.

    python benchmarks/atlas_index.py ATLAS [--sizes 1000 10000 100000 1000000] [--likeness 0.6 0.7
    0.8] [--figure FILE.png] [--json FILE]

Places are simulated with the statistics of real ones. Each is a mix of two place vectors of the
atlas with noise of their spread, at unit length. Queries are such places, turned by the angle of
images of the same place (`--likeness`, a cosine). The atlas's own code makes the index in a process
of its own. Another process opens it and runs the queries, with one thread.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import faiss
import numpy as np
from jaxtyping import Float16, Float32

from topoloc.atlas.atlas import Atlas
from topoloc.atlas.descriptor_shard import DescriptorShard
from topoloc.atlas.index import AtlasIndex, GlobalDescriptors, load_global_descriptors
from topoloc.atlas.index_files import open_index
from topoloc.atlas.manifest import PlacesFile, StoredFile, Tile
from topoloc.retrieval.descriptor_index import multiply_rows
from topoloc.retrieval.shared_vocabulary import shared_vocabulary

NUM_NEIGHBOURS, PLACES_A_TILE, CHUNK = 20, 250, 100_000


def made_up(
    true: Float32[np.ndarray, "n d"], count: int, rng: np.random.Generator
) -> Float32[np.ndarray, "m d"]:
    """Unit vectors like the true ones."""
    out = np.empty((count, true.shape[1]), np.float32)
    spread = true.std(axis=0)
    for start in range(0, count, CHUNK):
        size = min(CHUNK, count - start)
        one, other = (
            true[rng.integers(len(true), size=size)],
            true[rng.integers(len(true), size=size)],
        )
        mixed = one + rng.uniform(0, 1, (size, 1)).astype(np.float32) * other
        mixed += spread * rng.standard_normal(mixed.shape, np.float32)
        out[start : start + size] = mixed / np.linalg.norm(mixed, axis=1, keepdims=True)
    return out


def prepared(
    folder: Path,
    true: Float32[np.ndarray, "n d"],
    size: int,
    num_queries: int,
    likenesses: list[float],
) -> float:
    """Writes places and queries with their true neighbours; milliseconds of comparing one query
    with all places, the median."""
    rng = np.random.default_rng(0)
    places = made_up(true, size, rng).astype(np.float16)
    places.tofile(folder / "places")
    queries, exact = {}, {}
    for likeness in likenesses:
        own = rng.integers(size, size=num_queries)
        asked = places[own].astype(np.float32)
        away = made_up(true, num_queries, rng)
        away -= np.sum(away * asked, axis=1, keepdims=True) * asked
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        queries[str(likeness)] = asked = np.ascontiguousarray(
            likeness * asked + np.sqrt(1 - likeness**2) * away, np.float32
        )
        rows = nearest(places, asked)
        similar = np.einsum("qkd,qd->qk", places[rows].astype(np.float32), asked)
        exact[f"nearest {likeness}"] = rows
        exact[f"rival {likeness}"] = np.where(rows == own[:, None], -1.0, similar).max(axis=1)
        exact[f"rank {likeness}"] = np.where(
            (rows == own[:, None]).any(axis=1),
            np.argmax(rows == own[:, None], axis=1),
            NUM_NEIGHBOURS,
        )
    np.savez(folder / "queries.npz", **queries, **exact)  # pyright: ignore[reportArgumentType]
    compared, times, similarities = places.astype(np.float32), [], np.empty(size, np.float32)
    for query in queries[str(likenesses[0])][:20]:
        start = time.perf_counter()
        multiply_rows(compared, query, similarities)
        times.append(1e3 * (time.perf_counter() - start))
    return float(np.median(times))


def nearest(places: Float16[np.ndarray, "n d"], asked: Float32[np.ndarray, "q d"]) -> np.ndarray:
    """The numbers of the most similar places of each query."""
    best, numbers = (
        np.full((len(asked), NUM_NEIGHBOURS), -2.0, np.float32),
        np.zeros((len(asked), NUM_NEIGHBOURS), np.int64),
    )
    for start in range(0, len(places), CHUNK):
        similar = asked @ places[start : start + CHUNK].astype(np.float32).T
        both, rows = (
            np.hstack([best, similar]),
            np.hstack([numbers, np.tile(np.arange(similar.shape[1]) + start, (len(asked), 1))]),
        )
        order = np.argsort(-both, axis=1)[:, :NUM_NEIGHBOURS]
        best, numbers = np.take_along_axis(both, order, 1), np.take_along_axis(rows, order, 1)
    return numbers


def tiles_of(
    folder: Path, kind: str, dimension: int
) -> tuple[list[Tile], Callable[[Tile], GlobalDescriptors]]:
    """Hold tiles of successive places in the file, and their reader."""
    row, vocabulary = 2 * dimension, shared_vocabulary(kind)
    assert vocabulary is not None
    size = (folder / "places").stat().st_size // row
    count, box = max(1, size // PLACES_A_TILE), np.zeros((2, 3))
    bounds = np.linspace(0, size, count + 1).astype(int)
    tiles = []
    for number in range(count):
        stored = StoredFile(f"tiles/{number:07d}.places", f"{number:064x}", 1)
        versions = {kind: vocabulary.version}
        tiles.append(
            Tile(
                f"{number:07d}",
                stored,
                PlacesFile(stored.name, stored.sha256, 1, versions),
                "0" * 16,
                1,
                (kind,),
                PLACES_A_TILE,
                (),
                300.0,
                box,
                "w",
                None,
                None,
                None,
            )
        )

    def read(tile: Tile) -> GlobalDescriptors:
        least, most = bounds[int(tile.tile_id)], bounds[int(tile.tile_id) + 1]
        rows = np.fromfile(
            folder / "places", np.float16, (most - least) * dimension, offset=int(least) * row
        )
        return {kind: rows.reshape(-1, dimension).astype(np.float32)}

    return tiles, read


def memory_mb() -> dict[str, float]:
    """Of this process: at most, and now its own and of files."""
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return {
        name: int(status[name].split()[0]) / 1024
        for name in ("VmHWM", "VmRSS", "RssAnon", "RssFile")
    }


def opened(folder: Path, kind: str, dimension: int) -> tuple[AtlasIndex, dict[str, float]]:
    """Return the index, and the time and memory of opening it."""
    faiss.omp_set_num_threads(1)
    tiles, read = tiles_of(folder, kind, dimension)
    before, start = memory_mb(), time.perf_counter()
    index = open_index(tiles, read, folder / "index").index
    return index, {"s": time.perf_counter() - start, "mb": memory_mb()["VmHWM"] - before["VmRSS"]}


def made(folder: Path, kind: str, dimension: int) -> dict[str, float]:
    """Measure time and memory of making the index."""
    return opened(folder, kind, dimension)[1]


def asked(folder: Path, kind: str, dimension: int) -> dict[str, Any]:
    """Measure time, memory and recall of queries."""
    tiles, _ = tiles_of(folder, kind, dimension)
    multiply_rows(
        np.zeros((1, dimension), np.float32),
        np.zeros(dimension, np.float32),
        np.empty(1, np.float32),
    )  # compiled code is loaded
    before = memory_mb()
    index, facts = opened(folder, kind, dimension)
    with np.load(folder / "queries.npz") as stored:
        queries = {name: stored[name] for name in stored.files}
    bounds = np.cumsum(
        [
            0,
            *np.diff(
                np.linspace(
                    0, (folder / "places").stat().st_size // (2 * dimension), len(tiles) + 1
                ).astype(int)
            ),
        ]
    )
    rows = {}
    for likeness in (name for name in queries if " " not in name):
        times, hits, firsts = [], 0.0, 0
        for query, right in zip(queries[likeness], queries[f"nearest {likeness}"], strict=True):
            start = time.perf_counter()
            ranked = index.rank({kind: query}, NUM_NEIGHBOURS)
            times.append(1e3 * (time.perf_counter() - start))
            of_right = list(
                dict.fromkeys(
                    f"{np.searchsorted(bounds, place, 'right') - 1:07d}" for place in right
                )
            )
            hits += len({name for name, _ in ranked[: len(of_right)]} & set(of_right)) / len(
                of_right
            )
            firsts += ranked[0][0] == of_right[0]
        count = len(queries[likeness])
        rows[likeness] = {"ms": float(np.median(times)), "p90_ms": float(np.percentile(times, 90))}
        rows[likeness] |= {
            "recall_of_tiles": hits / count,
            "first": firsts / count,
            "rival": float(np.median(queries[f"rival {likeness}"])),
        }
        rows[likeness]["own_first"] = float(np.mean(queries[f"rank {likeness}"] == 0))
        rows[likeness]["own_among_nearest"] = float(
            np.mean(queries[f"rank {likeness}"] < NUM_NEIGHBOURS)
        )
    after = memory_mb()
    for likeness, row in rows.items():
        row["recall"] = recall_of_places(folder, queries, likeness)
    grown = {name: after[name] - before[name] for name in ("RssAnon", "RssFile")} | {
        "most": after["VmHWM"] - before["VmRSS"]
    }
    num_bytes = sum(path.stat().st_size for path in (folder / "index").glob("*.index"))
    return {
        "opened_s": facts["s"],
        "grown_mb": grown,
        "index_bytes": num_bytes,
        "by_likeness": rows,
    }


def recall_of_places(folder: Path, queries: dict[str, np.ndarray], likeness: str) -> float:
    """Return the recall of the true neighbours in equally many candidates of the shards, 1 without
    shards."""
    shards = sorted(
        (DescriptorShard.open(path) for path in (folder / "index").glob("*.index")),
        key=lambda shard: shard.tiles[0].tile_id,
    )
    if not shards:
        return 1.0
    firsts, hits = np.cumsum([0, *(len(shard.vectors) for shard in shards)]), 0
    for query, right in zip(queries[likeness], queries[f"nearest {likeness}"], strict=True):
        found = [shard.nearest(query, 1024, np.ones(len(shard.tiles), bool)) for shard in shards]
        rows = np.concatenate(
            [rows + first for (rows, _), first in zip(found, firsts, strict=False)]
        )
        best = np.argsort(-np.concatenate([similar for _, similar in found]), kind="stable")[
            :NUM_NEIGHBOURS
        ]
        hits += len(set(rows[best]) & set(right))
    return hits / (NUM_NEIGHBOURS * len(queries[likeness]))


def drawn(rows: dict[int, dict[str, Any]], path: Path) -> None:
    """Time, memory, the time of making, and look-alikes over the number of places, which is on a
    logarithmic axis."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    sizes = sorted(rows)
    figure, (left, right, alike) = plt.subplots(1, 3, figsize=(14, 4), layout="constrained")
    for likeness in rows[sizes[0]]["by_likeness"]:
        left.loglog(
            sizes,
            [rows[size]["by_likeness"][likeness]["ms"] for size in sizes],
            "o-",
            label=f"index, likeness {likeness}",
        )
    left.loglog(
        sizes,
        [rows[size]["exact_ms"] for size in sizes],
        "s--",
        color="grey",
        label="comparing all",
    )
    left.set(xlabel="places", ylabel="milliseconds a query, median, one thread")
    right.loglog(
        sizes,
        [rows[size]["grown_mb"]["most"] for size in sizes],
        "o-",
        label="memory, opened and asked (MB)",
    )
    of_files = [size for size in sizes if rows[size]["index_bytes"]]
    right.loglog(
        of_files, [rows[size]["index_bytes"] / 1e6 for size in of_files], "^-", label="files (MB)"
    )
    right.loglog(sizes, [rows[size]["made"]["s"] for size in sizes], "s-", label="made once (s)")
    right.loglog(sizes, [rows[size]["opened_s"] for size in sizes], "d-", label="opened (s)")
    right.set(xlabel="places", ylabel="megabytes, seconds")
    for likeness in rows[sizes[0]]["by_likeness"]:
        shares = [rows[size]["by_likeness"][likeness]["own_among_nearest"] for size in sizes]
        alike.semilogx(
            sizes, shares, "o-", label=f"own place among {NUM_NEIGHBOURS}, likeness {likeness}"
        )
    rivals = [
        np.mean([row["rival"] for row in rows[size]["by_likeness"].values()]) for size in sizes
    ]
    alike.semilogx(sizes, rivals, "s--", color="grey", label="likeness of the best look-alike")
    alike.set(xlabel="places", ylabel="share; likeness", ylim=(0, 1.05))
    for axes in (left, right, alike):
        axes.grid(True, which="major", alpha=0.3)
        axes.legend(fontsize=8)
    figure.savefig(path, dpi=110)


def printed(size: int, row: dict[str, Any]) -> None:
    grown = row["grown_mb"]
    for likeness, of_one in row["by_likeness"].items():
        print(
            f"{size:>9} places, likeness {likeness}: {of_one['ms']:.2f} ms (p90"
            f" {of_one['p90_ms']:.2f}; all {row['exact_ms']:.2f}); recall@{NUM_NEIGHBOURS} of"
            f" places {100 * of_one['recall']:.1f} %, tiles {100 * of_one['recall_of_tiles']:.1f}"
            f" %, nearest one first {100 * of_one['first']:.1f} %; best look-alike"
            f" {of_one['rival']:.3f}, own place first {100 * of_one['own_first']:.0f} %, among"
            f" {NUM_NEIGHBOURS} {100 * of_one['own_among_nearest']:.0f} %",
            flush=True,
        )
    print(
        f"{size:>9} places: made in {row['made']['s']:.1f} s with {row['made']['mb']:.0f} MB,"
        f" {row['index_bytes'] / 1e6:.0f} MB on disk; opened in {row['opened_s']:.2f} s, memory"
        f" grown by {grown['most']:.0f} MB at most ({grown['RssAnon']:.0f} own,"
        f" {grown['RssFile']:.0f} pages of files)",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("atlas")
    parser.add_argument("--sizes", type=int, nargs="+", default=[1_000, 10_000, 100_000, 1_000_000])
    parser.add_argument("--queries", type=int, default=200)
    parser.add_argument("--kind", default="surf")
    parser.add_argument("--likeness", type=float, nargs="+", default=[0.6, 0.7, 0.8])
    parser.add_argument("--figure", type=Path)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    atlas = Atlas.open(args.atlas)
    of_tiles = [
        load_global_descriptors(
            atlas.store.local_path(tile.places.name, tile.places.sha256), tile.places.vocabularies
        )
        for tile in atlas.manifest.tiles
    ]
    true, rows = (
        np.concatenate([vectors[args.kind] for vectors in of_tiles if args.kind in vectors]),
        {},
    )
    for size in args.sizes:
        with tempfile.TemporaryDirectory() as name:
            of_places = (args.kind, true.shape[1])
            steps = [
                (prepared, (true, size, args.queries, args.likeness)),
                (made, of_places),
                (asked, of_places),
            ]
            results = []
            for step, arguments in steps:  # each in a process of its own
                with get_context("spawn").Pool(1) as pool:
                    results.append(pool.apply(step, (Path(name), *arguments)))
        rows[size] = {"exact_ms": results[0], "made": results[1], **results[2]}
        printed(size, rows[size])
    if args.figure:
        drawn(rows, args.figure)
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
