"""Table III: seconds a stage, for each coarse localizer, on the machine at hand."""

from __future__ import annotations

import os
import platform
from typing import Any

import numpy as np

from topoloc.errors import TrainingError, WeightsError
from topoloc.localization.localizer import Localizer
from topoloc.mapping.topomap import TopoMetricMap
from topoloc_paper.asking import WARM_UP, queries_of
from topoloc_paper.datasets import Dataset
from topoloc_paper.maps import MapKind, opened, why_not
from topoloc_paper.published import TABLE_THREE
from topoloc_paper.settings import LEARNED, Bench, sequence_digest
from topoloc_paper.stage_code import COARSE_MODULES, asking

STAGES = ("patch_normalization", "features", "coarse", "matching", "pnp", "total")


def rows(bench: Bench, datasets: list[Dataset]) -> list[dict[str, Any]]:
    """Return a row for each data set and coarse localizer: median and quartiles (seconds) of every
    stage.

    The first recording is measured. All localizers take turns on each image, so other work of the
    machine slows all alike. "load" is the load average of the machine.
    """
    return [row for dataset in datasets for row in _rows(bench, dataset)]


def machine() -> dict[str, Any]:
    """Describe the machine on which the times were measured."""
    model = next(
        (line.partition(":")[2].strip() for line in _cpu_lines() if line.startswith("model name")),
        platform.processor(),
    )
    return {
        "cpu": model,
        "cores": os.cpu_count(),
        "system": platform.system(),
        "python": platform.python_version(),
    }


def _rows(bench: Bench, dataset: Dataset) -> list[dict[str, Any]]:
    label = next(iter(dataset.queries))
    kind, sequence = MapKind.as_paper(dataset), queries_of(bench, dataset, label)
    heads: dict[str, dict[str, Any]] = {}
    maps: dict[str, tuple[TopoMetricMap, str]] = {}
    for method in ("surf-vlad", *LEARNED):
        heads[method] = {
            "dataset": dataset.name,
            "method": method,
            "weights": bench.config.weights.words(method),
        }
        heads[method]["paper_s"] = TABLE_THREE.get(method, {}).get("total")
        if missing := why_not(bench, method):
            heads[method]["missing"] = missing
            continue
        try:
            maps[method] = opened(bench, dataset, kind, method)
        except (TrainingError, WeightsError) as error:
            heads[method]["missing"] = str(error)

    def ask() -> dict[str, Any]:
        localizers = {method: Localizer(topomap) for method, (topomap, _) in maps.items()}
        times: dict[str, list[dict[str, float]]] = {method: [] for method in localizers}
        for i in [*range(min(WARM_UP, len(sequence))), *range(len(sequence))]:
            frame = sequence[i]
            assert frame.camera is not None
            for method, localizer in localizers.items():
                times[method].append(localizer.localize(frame.image, frame.camera).times_ms)
            bench.progress(f"times in {dataset.name}", i + 1, len(sequence))
        kept = {method: rows[min(WARM_UP, len(sequence)) :] for method, rows in times.items()}
        load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
        return {
            "times": {method: _quartiles(rows) for method, rows in kept.items()},
            "num_queries": len(sequence),
            "load": load,
        }

    settings = {
        "maps": {method: digest for method, (_, digest) in maps.items()},
        "queries": sequence_digest(sequence),
    }
    done = bench.store.get(
        f"times-{dataset.name}",
        settings,
        ask,
        asking("surf-vlad", *(COARSE_MODULES[method] for method in maps)),
    ).result
    facts = {"num_queries": done["num_queries"], "load": done["load"]}
    return [
        head | ({"quartiles_s": done["times"][method]} | facts if method in maps else {})
        for method, head in heads.items()
    ]


def _quartiles(rows: list[dict[str, float]]) -> dict[str, list[float]]:
    """Seconds: lower quartile, median, upper quartile of each stage."""
    return {
        stage: [
            float(q)
            for q in np.percentile([1e-3 * row.get(stage, 0.0) for row in rows], [25, 50, 75])
        ]
        for stage in STAGES
    }


def _cpu_lines() -> list[str]:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            return file.readlines()
    except OSError:
        return []
