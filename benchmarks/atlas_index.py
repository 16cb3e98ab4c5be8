"""The coarse search of an atlas over more and more places: time, recall of exact search, memory.

    python benchmarks/atlas_index.py ATLAS [--sizes 1000 10000 100000 1000000] [--queries 200] [--kind surf]

Places are made up with the statistics of true ones: each is a mix of two place vectors of the atlas with noise of their spread, brought
to unit length; queries are places of it, turned away by as much as pictures of the same place are (`--likeness`). Each size runs in a
process of its own, one thread.
"""

from __future__ import annotations

import argparse
import resource
import time
from multiprocessing import get_context
from typing import Any

import faiss
import numpy as np
from jaxtyping import Float32

from topoloc.atlas.atlas import Atlas
from topoloc.atlas.index import AtlasIndex
from topoloc.atlas.place_vectors import read_vectors

NUM_NEIGHBOURS, PLACES_A_TILE = 20, 250


def made_up(true: Float32[np.ndarray, "n d"], count: int, rng: np.random.Generator) -> Float32[np.ndarray, "m d"]:
    """Unit vectors like the true ones."""
    out = np.empty((count, true.shape[1]), np.float32)
    spread = true.std(axis=0)
    for start in range(0, count, 100_000):
        size = min(100_000, count - start)
        one, other = true[rng.integers(len(true), size=size)], true[rng.integers(len(true), size=size)]
        mixed = one + rng.uniform(0, 1, (size, 1)).astype(np.float32) * other
        mixed += spread * rng.standard_normal(mixed.shape, np.float32)
        out[start : start + size] = mixed / np.linalg.norm(mixed, axis=1, keepdims=True)
    return out


def measured(true: Float32[np.ndarray, "n d"], size: int, num_queries: int, likeness: float) -> dict[str, Any]:
    """The figures of one size."""
    faiss.omp_set_num_threads(1)
    rng = np.random.default_rng(0)
    places = made_up(true, size, rng)
    asked = places[rng.integers(size, size=num_queries)]
    away = made_up(true, num_queries, rng)
    away -= np.sum(away * asked, axis=1, keepdims=True) * asked
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    asked = np.ascontiguousarray(likeness * asked + np.sqrt(1 - likeness**2) * away, np.float32)
    exact = np.array([np.argsort(-(places @ query), kind="stable")[:NUM_NEIGHBOURS] for query in asked])
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter()
    tiles = [{"places": part} for part in np.array_split(places, max(1, size // PLACES_A_TILE))]
    index = AtlasIndex([str(number) for number in range(len(tiles))], tiles)
    made_s = time.perf_counter() - start
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    bounds, times, hits, firsts = np.cumsum([0, *(len(tile["places"]) for tile in tiles)]), [], 0, 0
    for query, right in zip(asked, exact, strict=True):
        start = time.perf_counter()
        found = index.rank({"places": query}, NUM_NEIGHBOURS)
        times.append(1e3 * (time.perf_counter() - start))
        right_tiles = [str(np.searchsorted(bounds, place, "right") - 1) for place in right]
        hits += len({name for name, _ in found} & set(right_tiles)) / len(set(right_tiles))
        firsts += found[0][0] == right_tiles[0]
    recall = {"recall": hits / len(asked), "first": firsts / len(asked)}
    return recall | {"ms": float(np.median(times)), "made_s": made_s, "grown_mb": grown}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("atlas")
    parser.add_argument("--sizes", type=int, nargs="+", default=[1_000, 10_000, 100_000, 1_000_000])
    parser.add_argument("--queries", type=int, default=200)
    parser.add_argument("--kind", default="surf")
    parser.add_argument("--likeness", type=float, default=0.7)
    args = parser.parse_args()
    atlas = Atlas.open(args.atlas)
    of_tiles = [read_vectors(atlas.store.local(tile.places.name, tile.places.sha256), tile.vocabularies) for tile in atlas.manifest.tiles]
    true = np.concatenate([vectors[args.kind] for vectors in of_tiles if args.kind in vectors])
    for size in args.sizes:
        with get_context("spawn").Pool(1) as pool:
            row = pool.apply(measured, (true, size, args.queries, args.likeness))
        nearest = f"of the tiles of the {NUM_NEIGHBOURS} nearest places among the first {NUM_NEIGHBOURS}"
        print(
            f"{size:>9} places: {row['ms']:.2f} ms; {100 * row['recall']:.1f} % {nearest}, the nearest one's first "
            f"{100 * row['first']:.1f} %; made in {row['made_s']:.1f} s, memory grown by {row['grown_mb']:.0f} MB",
            flush=True,
        )


if __name__ == "__main__":
    main()
