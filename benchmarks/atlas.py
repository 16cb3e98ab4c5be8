"""Compare an atlas with the maps of its tiles on the same images.

    python benchmarks/atlas.py ATLAS TILE=RECORDING ... [--elsewhere RECORDING ...] [--alike c1,c2]
    [--memory-mb 256] [--json FILE]

Each image is localized in its own tile's map alone and in the atlas, in turns, in one process.
`--alike` names tiles of similar places (two fittings of one building). An answer in another of them
is counted apart, and compared with the recording's truth. An image of `--elsewhere` is localized in
each tile's map alone, and in the atlas. Its time is compared with the mean of theirs.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from topoloc.atlas.atlas import Atlas
from topoloc.atlas.map_cache import MapCache
from topoloc.geometry.alignment import translation_error
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization, NotLocalized
from topoloc.mapping.node_cache import set_node_cache_size
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import StereoFrame
from topoloc.recordings.open import open_sequence
from topoloc.recordings.recording import as_monocular
from topoloc.tracking.warm_up import warm_up

RIGHT_METRES = 0.5


def asked(
    localizer: Localizer, alone: Localizer, tile_id: str, frame: StereoFrame, alike: set[str]
) -> dict[str, Any]:
    """Localize one image in the map alone and in the atlas."""
    assert frame.camera is not None
    start = time.process_time()
    by_map = alone.localize(frame.image, frame.camera)
    middle = time.process_time()
    by_atlas = localizer.localize(frame.image, frame.camera)
    end = time.process_time()
    ranking = [name for name, _ in localizer.rank_tiles(frame.image, frame.camera)]
    answer = by_atlas.provenance.tile if isinstance(by_atlas, Localization) else None
    outcome = (
        "right"
        if answer == tile_id
        else "none"
        if answer is None
        else "alike"
        if {answer, tile_id} <= alike
        else "false"
    )
    row: dict[str, Any] = {
        "alone": by_map.localized,
        "outcome": outcome,
        "answer": answer,
        "rank": ranking.index(tile_id) + 1,
    }
    if isinstance(by_atlas, NotLocalized):
        row["reason"] = by_atlas.reason
        row["tiles"] = [one.tile for one in by_atlas.alternatives]
    elif outcome == "alike" and frame.world_from_cam is not None:
        row["metres_off"] = translation_error(by_atlas.world_from_cam, frame.world_from_cam)
    return row | {
        "name": frame.name,
        "ms_alone": 1e3 * (middle - start),
        "ms_atlas": 1e3 * (end - middle),
    }


def asked_elsewhere(
    localizer: Localizer, alone: dict[str, Localizer], frame: StereoFrame
) -> dict[str, Any]:
    """Localize one out-of-map image in each map alone and in the atlas."""
    assert frame.camera is not None
    ms_alone, poses = [], 0
    for one in alone.values():
        start = time.process_time()
        poses += isinstance(one.localize(frame.image, frame.camera), Localization)
        ms_alone.append(1e3 * (time.process_time() - start))
    start = time.process_time()
    result = localizer.localize(frame.image, frame.camera)
    ms_atlas = 1e3 * (time.process_time() - start)
    answer = result.provenance.tile if isinstance(result, Localization) else None
    return {
        "name": frame.name,
        "answer": answer,
        "poses_alone": poses,
        "ms_alone": float(np.mean(ms_alone)),
        "ms_atlas": ms_atlas,
    }


def elsewhere_line(name: str, rows: list[dict[str, Any]]) -> str:
    """The figures of a recording of elsewhere, or of all."""
    ratios = [row["ms_atlas"] / row["ms_alone"] for row in rows]
    by_atlas, by_maps = (
        sum(row["answer"] is not None for row in rows),
        sum(row["poses_alone"] for row in rows),
    )
    return (
        f"{name:24} {len(rows):4} pictures of elsewhere: poses by the atlas {by_atlas}, by single"
        f" maps {by_maps}; time {np.median(ratios):.2f} of a single map's in the median,"
        f" {np.min(ratios):.2f} to {np.max(ratios):.2f}"
    )


def line(name: str, rows: list[dict[str, Any]]) -> str:
    """The figures of a recording, or of all."""
    outcomes, of_alone = (
        Counter(row["outcome"] for row in rows),
        [row for row in rows if row["alone"]],
    )
    kept = sum(row["outcome"] in ("right", "alike") for row in of_alone)
    alike = [row["metres_off"] for row in rows if "metres_off" in row]
    ratio = np.median([row["ms_atlas"] for row in rows]) / np.median(
        [row["ms_alone"] for row in rows]
    )
    each = np.median([row["ms_atlas"] / row["ms_alone"] for row in rows])
    first = np.mean([row["rank"] == 1 for row in rows])
    return (
        f"{name:24} {len(rows):4} pictures; alone {len(of_alone)}, of these {kept}"
        f" ({100 * kept / max(len(of_alone), 1):.1f} %); right {outcomes['right']}, alike"
        f" {outcomes['alike']} ({sum(off < RIGHT_METRES for off in alike)} right by truth), false"
        f" {outcomes['false']}, none {outcomes['none']}"
        f" ({sum(row.get('reason') == 'ambiguous' for row in rows)} ambiguous); time {ratio:.2f} of"
        f" the medians, {each:.2f} median; right tile first {100 * first:.0f} %, rank at most"
        f" {max(row['rank'] for row in rows)}"
    )


def ask_elsewhere(
    atlas: Atlas, localizer: Localizer, paths: list[str]
) -> dict[str, list[dict[str, Any]]]:
    """The rows of each recording, which are printed."""
    rows = dict[str, list[dict[str, Any]]]()
    with ExitStack() as opened:
        maps = {
            tile.tile_id: opened.enter_context(TopoMetricMap.load(atlas.map_path(tile)))
            for tile in atlas.manifest.tiles
        }
        alone = {tile_id: Localizer(topomap) for tile_id, topomap in maps.items()}
        for path in paths:
            sequence = as_monocular(open_sequence(path))
            rows[path] = [
                asked_elsewhere(localizer, alone, sequence[k]) for k in range(len(sequence))
            ]
            print(elsewhere_line(Path(path).name, rows[path]), flush=True)
    print(elsewhere_line("all", [row for of_one in rows.values() for row in of_one]))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("atlas")
    parser.add_argument("recordings", nargs="+", metavar="TILE=RECORDING")
    parser.add_argument("--elsewhere", nargs="+", default=[], metavar="RECORDING")
    parser.add_argument("--alike", default="")
    parser.add_argument("--memory-mb", type=int, default=256)
    parser.add_argument("--json")
    args = parser.parse_args()
    warm_up()
    atlas = Atlas.open(args.atlas)
    set_node_cache_size(args.memory_mb * 500_000)
    localizer = Localizer(atlas, maps=MapCache([], Localizer, args.memory_mb * 500_000))
    rows: dict[str, list[dict[str, Any]]] = {}
    for pair in args.recordings:
        tile_id, path = pair.split("=", 1)
        with TopoMetricMap.load(atlas.map_path(atlas.tile(tile_id))) as topomap:
            sequence, alone = as_monocular(open_sequence(path)), Localizer(topomap)
            of_one = [
                asked(localizer, alone, tile_id, sequence[k], set(args.alike.split(",")))
                for k in range(len(sequence))
            ]
        rows[pair] = of_one
        print(line(f"{tile_id} {Path(path).name}", of_one), flush=True)
    print(line("all", [row for of_one in rows.values() for row in of_one]))
    if args.elsewhere:
        rows |= ask_elsewhere(atlas, localizer, args.elsewhere)
    print(f"most memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")
    if args.json:
        Path(args.json).write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
