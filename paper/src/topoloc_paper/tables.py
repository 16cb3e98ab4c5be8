"""All tables of a run as one JSON value, and which part of the benchmark makes which."""

from __future__ import annotations

from typing import Any, Literal

from topoloc_paper import (
    ablation,
    node_sweep,
    normalization,
    peers,
    stage_times,
    table_one,
    targets,
)
from topoloc_paper.settings import LEARNED, Bench

Part = Literal["paper", "conditions", "nodes", "speed", "peers", "recordings"]
# What each part fills in.
TABLES: dict[Part, tuple[str, ...]] = {
    "paper": ("accuracy", "normalization", "nodes", "speed", "peers", "ablation", "targets"),
    "conditions": ("accuracy", "normalization"),
    "nodes": ("nodes",),
    "speed": ("speed",),
    "peers": ("peers",),
    "recordings": ("accuracy", "normalization", "peers"),
}


def tables_of(bench: Bench, part: Part) -> dict[str, Any]:
    """Compute the tables of a part. `recordings` uses real recordings alone, all others but `paper`
    and `peers` rendered ones alone.

    Raises:
        TopolocError: a stage failed. The results of earlier stages are kept.
    """
    rendered, real = list(bench.rendered), list(bench.real)
    datasets = (
        real
        if part == "recordings"
        else rendered + real
        if part in ("paper", "peers")
        else rendered
    )
    wanted = TABLES[part]
    results: dict[str, Any] = {
        "machine": stage_times.machine(),
        "settings": _settings(bench),
        "missing": list(bench.missing),
    }
    if "accuracy" in wanted:
        results["accuracy"] = table_one.all_rows(bench, datasets)
    if "normalization" in wanted:
        results["normalization"] = normalization.rows(bench, datasets)
    if "nodes" in wanted:
        results["nodes"] = node_sweep.rows(bench, rendered)
    if "speed" in wanted:
        results["speed"] = stage_times.rows(bench, rendered)
    if "peers" in wanted:
        results["peers"] = peers.rows(bench, datasets)
    if "ablation" in wanted:
        results["ablation"] = ablation.rows(bench, rendered)
    if "targets" in wanted:
        results["targets"] = targets.rows(
            results["accuracy"], results["ablation"], results["speed"]
        )
    return results


def _settings(bench: Bench) -> dict[str, Any]:
    c = bench.config
    weights = {method: c.weights.words(method) for method in ("posenet", *LEARNED)}
    rendered = {
        dataset.name: {"mapping": list(dataset.mapping), "queries": list(dataset.queries)}
        for dataset in bench.rendered
    }
    names = {name: [_last(path) for path in one["mapping"]] for name, one in rendered.items()}
    quality = "the demo's" if c.quick else "draft" if c.draft else "normal"
    return {
        "command": bench.command,
        "quality": quality,
        "weights": weights,
        "mapping": names,
        "quick": c.quick,
        "epochs": c.epochs,
    } | {
        "posenet_epochs": c.posenet_epochs,
        "posenet_losses": list(c.posenet_losses),
        "max_colmap_images": c.max_colmap_images,
    }


def _last(path: str) -> str:
    return path.rstrip("/").rpartition("/")[2]
