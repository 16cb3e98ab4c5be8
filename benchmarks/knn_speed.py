"""Nearest neighbours among many place vectors: milliseconds, recall of the exact answer, memory.

    python benchmarks/knn_speed.py [--sizes 1000 30000 1000000] [--dimension 256] [--json FILE]

The vectors are made as mapping gives them: walks through the space of places, each image much like
the one before, as many dimensions with as uneven variances as whitened features have. Queries are
images of the same walks, seen a little otherwise (cosine about 0.8). The paper's own search takes
198 ms (cnn-nn) and 267 ms (vlad-nn).
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from pathlib import Path

import faiss
import numpy as np

from topoloc.retrieval.descriptor_index import DescriptorIndex

NUM_QUERIES = 200


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sizes", type=int, nargs="+", default=[1000, 30_000, 1_000_000])
    parser.add_argument("--dimension", type=int, default=256)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = [measure(size, arguments.dimension) for size in arguments.sizes]
    print(
        f"{'vectors':>9}  {'build s':>7}  {'ms':>6}  {'ms median':>9}  {'recall@1':>8}  {'MB':>6}"
    )
    for row in rows:
        print(
            f"{row['vectors']:>9}  {row['build_s']:>7.1f}  {row['ms_least']:>6.2f} "
            f" {row['ms_median']:>9.2f}  {row['recall_at_1']:>8.3f}  {row['index_mb']:>6.0f}"
        )
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1))


def measure(size: int, dimension: int) -> dict[str, float]:
    rng = np.random.default_rng(0)
    vectors = walks(size, dimension, rng)
    truth_rows = rng.integers(0, size, NUM_QUERIES)
    queries = unit(vectors[truth_rows] + 0.75 * unit(rng.standard_normal((NUM_QUERIES, dimension))))
    exact = np.concatenate(
        [np.argmax(queries[i : i + 8] @ vectors.T, axis=1) for i in range(0, NUM_QUERIES, 8)]
    )
    before, start = peak_mb(), time.perf_counter()
    index = DescriptorIndex(vectors, np.arange(size))
    build_s = time.perf_counter() - start
    times, hits = [], 0
    for query, row in zip(queries, exact, strict=True):
        start = time.perf_counter()
        (best,) = index.rank_nodes(query, 1)
        times.append((time.perf_counter() - start) * 1e3)
        hits += best.row == row
    index_mb = (
        faiss.serialize_index(index._cells).nbytes / 1e6
        if index._cells is not None
        else vectors.nbytes / 1e6
    )
    row = {
        "vectors": size,
        "build_s": build_s,
        "ms_least": min(times),
        "ms_median": float(np.median(times)),
    }
    return row | {
        "recall_at_1": hits / NUM_QUERIES,
        "index_mb": index_mb,
        "peak_growth_mb": peak_mb() - before,
    }


def walks(size: int, dimension: int, rng: np.random.Generator, length: int = 500) -> np.ndarray:
    """Unit vectors (size, dimension) of walks of `length` images: neighbours have a cosine of about
    0.9, strangers of about 0."""
    num_walks = -(-size // length)
    knots = rng.standard_normal((num_walks, length // 5 + 2, dimension)).astype(
        np.float32
    ) * np.linspace(1.6, 0.4, dimension, dtype=np.float32)
    at = np.linspace(0.0, length / 5, length, dtype=np.float32)
    left = at.astype(int)
    share = (at - left)[None, :, None]
    return unit(
        ((1.0 - share) * knots[:, left] + share * knots[:, left + 1]).reshape(-1, dimension)[:size]
    )


def unit(vectors: np.ndarray) -> np.ndarray:
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()
