"""Read damaged maps, kept files, manifests, global descriptors, recordings, images, settings and
cameras in child processes: how many end in a traceback, hang, crash or take much memory?

    python benchmarks/fuzz.py                               # each kind of input, 1000 each
    python benchmarks/fuzz.py maps undo --inputs 20000 --first-seed 5000 --processes 2

A child has 1.5 GB, and 30 s of the processor for each input. Findings are printed with their seed,
and the counts as a table. The exit status is 1 if there is a finding.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from fuzzers.atlases import Manifests, PlaceVectors
from fuzzers.harness import Fuzzer, run_child, run_fuzzers
from fuzzers.maps import Maps, UndoFiles
from fuzzers.recordings import Images, Recordings
from fuzzers.settings import Calibrations, QueryCameras, Settings

FUZZERS: dict[str, Fuzzer] = {
    "maps": Maps(),
    "undo": UndoFiles(),
    "manifests": Manifests(),
    "places": PlaceVectors(),
    "recordings": Recordings(),
    "images": Images(),
    "settings": Settings(),
    "calibrations": Calibrations(),
    "cameras": QueryCameras(),
}


def main() -> int:
    if sys.argv[1:2] == ["--child"]:
        run_child(_select(sys.argv[2].split(",")), sys.argv[3:])
        return 0
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {', '.join(FUZZERS)}")
    parser.add_argument("--inputs", type=int, default=1000, help="of each kind")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=2)
    args = parser.parse_args()
    kinds = args.kinds or list(FUZZERS)
    if unknown := set(kinds) - FUZZERS.keys():
        parser.error(f"no such kind: {', '.join(unknown)}; kinds: {', '.join(FUZZERS)}")
    warnings.simplefilter("ignore")  # maps of earlier versions
    seeds = range(args.first_seed, args.first_seed + args.inputs)
    command = [sys.executable, __file__, "--child", ",".join(kinds)]
    tally = run_fuzzers(command, _select(kinds), seeds, args.processes)
    print(tally.table())
    print(f"{tally.total} inputs, {len(tally.findings)} findings")
    return int(bool(tally.findings))


def _select(kinds: list[str]) -> dict[str, Fuzzer]:
    return {name: FUZZERS[name] for name in kinds}


if __name__ == "__main__":
    sys.exit(main())
