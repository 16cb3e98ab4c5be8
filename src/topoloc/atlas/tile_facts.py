"""Compute the entries of a tile in the manifest that follow from its map, and compare them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from msgspec import structs

from topoloc.atlas.joint_worlds import geo_box
from topoloc.atlas.manifest import Tile
from topoloc.mapping.topomap import TopoMetricMap


def find_other_facts(tile: Tile, path: Path) -> list[str]:
    """Return the names of those facts of a tile that its map at `path` contradicts. Raises
    MapError."""
    with TopoMetricMap.load(path) as topomap:
        facts = map_facts(topomap)
    if facts["georeference"] is None:
        facts["geo_box"] = tile.geo_box  # it may follow from other tiles
    entry, expected = tile.to_json(), structs.replace(tile, **facts).to_json()
    boxes = [np.array(one.pop("geo_box") or [], np.float64) for one in (entry, expected)]
    # the last digits of trigonometric functions depend on the machine
    is_same_box = boxes[0].shape == boxes[1].shape and np.allclose(*boxes, rtol=0.0, atol=1e-9)
    other = [key for key in expected if entry[key] != expected[key]]
    return other if is_same_box else [*other, "geo_box"]


def map_facts(topomap: TopoMetricMap) -> dict[str, Any]:
    """Return the entries of a tile that follow from its map."""
    centres = np.array([summary.world_from_cam.translation for summary in topomap.summaries])
    known = topomap.georeference
    return {
        "map_id": topomap.id,
        "map_version": topomap.version,
        "kinds": tuple(topomap.kinds),
        "num_nodes": len(topomap.summaries),
        "sessions": tuple(sorted({summary.recording for summary in topomap.summaries})),
        "focal_px": topomap.max_focal_length_px(),
        "box_world": np.array([centres.min(axis=0), centres.max(axis=0)]),
        "georeference": known,
        "geo_box": None if known is None else geo_box([*map(known.geopoint, centres)]),
    }
