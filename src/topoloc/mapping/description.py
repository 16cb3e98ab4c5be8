"""Describe the contents of a map in numbers and words."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from topoloc.errors import EmptyMapError
from topoloc.mapping.sessions import Session
from topoloc.mapping.storage.integrity_check import list_coarse_models
from topoloc.mapping.topomap import TopoMetricMap


def describe_map(topomap: TopoMetricMap, path: Path) -> dict[str, Any]:
    """Return the facts of a map for evaluations and `info`: counts, bytes, extent, configuration.

    Raises:
        EmptyMapError: the map has no node.
    """
    if len(topomap.summaries) == 0:
        raise EmptyMapError(f"map {path} has no nodes")
    models = list_coarse_models(path)
    centres = np.array([s.world_from_cam.translation for s in topomap.summaries])
    return {
        "path": str(path),
        "map": topomap.id,
        "version": topomap.version,
        "georeference": None if topomap.georeference is None else topomap.georeference.to_json(),
        "bytes": path.stat().st_size,
        "num_nodes": len(topomap.summaries),
        "num_points": sum(s.num_points for s in topomap.summaries),
        "num_side_nodes": len(topomap.sides.summaries) if topomap.sides else 0,
        "num_place_images": len(topomap.place_images),
        "length_m": round(topomap.length_m, 3),
        "extent_m": np.ptp(centres, axis=0).round(3).tolist(),
        "recordings": sorted({s.recording for s in topomap.summaries}),
        "sessions": [_session_facts(session) for session in topomap.sessions],
        "edits": [asdict(edit) for edit in topomap.edits],
        "coarse": [model["name"] for model in models],
        "default_coarse": topomap.default_coarse,
        "kinds": topomap.kinds,
        "coarse_models": models,
        "config": topomap.config.to_json(),
    }


def _session_facts(session: Session) -> dict[str, Any]:
    camera = None if session.camera is None else session.camera.to_json()
    return asdict(session) | {
        "camera": camera,
        "start_date": session.start_date,
        "end_date": session.end_date,
    }
