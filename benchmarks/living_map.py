"""A map that takes recordings of a changing place in and forgets what is gone, beside the same map never updated.

    python benchmarks/living_map.py MAP_SEQ WALK [WALK ...] [--step 4] [--sizes 12 8 6]

Builds a map of MAP_SEQ; each WALK then joins it (of a single camera by the map's answers, else by its poses) and what is gone is pruned.
Prints for each walk how many of every `step`-th of its pictures the map localizes that was never updated, the living one before the walk
joins, and after: localized, wrong (off by more than 0.5 m or 5 degrees), median error; and the living map's bytes. With `--sizes`
the last map is pruned to each of these sizes (MB), and asked of the last walk.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from topoloc import Localizer, TopoMetricMap, build_map, open_sequence
from topoloc.errors import MapError
from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.lifelong.prune import prune_map
from topoloc.lifelong.update import update_map
from topoloc.localization.result import Localization
from topoloc.map.edit import editing
from topoloc.sequences.frame import StereoSequence


def asked(path: Path, sequence: StereoSequence, step: int) -> str:
    """How the map does on every `step`-th picture, in one line."""
    errors, wrong, num = list[float](), 0, 0
    with TopoMetricMap.load(path) as topomap:
        localizer = Localizer(topomap)
        for index in range(1, len(sequence), step):
            frame = sequence[index]
            result = localizer.localize(frame.image, frame.camera)
            num += 1
            if isinstance(result, Localization) and frame.world_from_cam is not None:
                errors.append(translation_error(frame.world_from_cam, result.world_from_cam))
                degrees = np.degrees(rotation_error(frame.world_from_cam, result.world_from_cam))
                wrong += errors[-1] > 0.5 or degrees > 5.0
    return f"{len(errors)} of {num}, {wrong} wrong, {100 * float(np.median(errors or [np.nan])):.2f} cm"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("map_sequence")
    parser.add_argument("walks", nargs="+")
    parser.add_argument("--step", type=int, default=4)
    parser.add_argument("--sizes", type=float, nargs="*", default=[])
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        never, living = Path(folder) / "never.topo", Path(folder) / "living.topo"
        start = time.process_time()
        topomap = build_map(open_sequence(args.map_sequence))
        seconds = time.process_time() - start
        topomap.save(never)
        topomap.save(living)
        print(f"map: {living.stat().st_size / 1e6:.2f} MB, {len(topomap.summaries)} nodes, {seconds:.0f} s of processor time", flush=True)
        for walk in args.walks:
            sequence = open_sequence(walk)
            print(f"{walk}: never updated {asked(never, sequence, args.step)}; before {asked(living, sequence, args.step)}", flush=True)
            start = time.process_time()
            joined(living, sequence)
            seconds = time.process_time() - start
            print(f"  joined and pruned in {seconds:.0f} s of processor time: {asked(living, sequence, args.step)}")
            print(f"  {living.stat().st_size / 1e6:.2f} MB", flush=True)
        for size in args.sizes:
            with editing(living) as edit:
                try:
                    smaller = prune_map(edit.topomap, living, round(size * 1e6))
                except MapError as error:
                    print(f"{size:g} MB: {error}")
                    continue
                edit.commit(smaller.topomap, f"prune to {size:g} MB")
            print(f"{living.stat().st_size / 1e6:.2f} MB: {asked(living, open_sequence(args.walks[-1]), args.step)}", flush=True)


def joined(path: Path, sequence: StereoSequence) -> None:
    """The walk joins, then what is gone is dropped."""
    first = sequence[0]
    is_single = first.right is None and first.depth is None
    with editing(path) as edit:
        update = update_map(edit.topomap, sequence, "map" if is_single else "truth")
        edit.commit(update.topomap, "update", update.changes)
    with editing(path) as edit:
        pruned = prune_map(edit.topomap, path)
        edit.commit(pruned.topomap, "prune", pruned.changes)


if __name__ == "__main__":
    main()
