"""The keys of the JSON that commands write, and functions that read it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

EVALUATION = {
    "num_queries",
    "num_localized",
    "median_translation_m",
    "median_rotation_deg",
    "recall",
    "topological_accuracy",
}
EVALUATION |= {"false_accepts", "median_times_ms", "map"}
EVIDENCE = {"query", "localized", "candidates", "num_matches", "num_inliers", "times_ms"}
PROVENANCE = {"map", "version", "t_ns", "camera", "features"}
SIGMAS = {"position_sigma_m", "rotation_sigma_deg"}
POSE = {"world_from_cam", "covariance", "probability", "node", "evidence", "noise_share"}
STAGES = {"patch_normalization", "features", "coarse", "matching", "pnp", "total"}


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Return the objects of a file with one JSON object in each line."""
    return [json.loads(line) for line in path.read_text().splitlines()]


def without_times(data: dict[str, Any]) -> dict[str, Any]:
    """Return a JSON object without its times and paths, also in its parts."""
    kept = {
        key: value
        for key, value in data.items()
        if key not in ("times_ms", "median_times_ms", "path")
    }
    return kept | {
        name: [without_times(part) for part in data[name]]
        for name in ("recordings", "answers")
        if name in data
    }
