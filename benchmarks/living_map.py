"""A map that takes recordings of a changing place in, by the commands that a user has, beside maps
that do not.

    python benchmarks/living_map.py MAP_SEQ [WALK ...] --ask NAME=SEQ [NAME=SEQ ...] [--step 1]
        [--trajectory slam] [--single map] [--prune] [--budget 1.5] [--unlimited] [--alone]
        [--ask-each] [--features surf,topoloc-net] [--settings FILE.toml]

`topoloc build` maps MAP_SEQ by its own poses; each WALK then joins by `topoloc update`: of stereo
or RGB-D by `--trajectory` (slam, as a user has it who carries a camera and nothing else), of a
single camera by `--single` (map: the map's answers, truth: its own poses). WALK=LIGHT names the
light. With `--prune` the map is pruned after each, with `--budget F` to F times the bytes of the
map as it was built. Beside it stand the map never updated and, with `--unlimited`, the same map
that is never pruned. `--settings` are those of `update` and `prune`: with `min_inliers = 10000` in
the table `[update]` every picture of a session becomes a node, so that a budget binds.

Printed for each walk: bytes, nodes, processor time and the memory at most of `update` and of
`prune`; with `--alone` what building the walk alone takes. At the end (with `--ask-each` after each
walk, too) every `step`-th picture of each NAME is asked as a single picture: localized, wrong (off
by more than 0.5 m or 5 degrees), median errors. The folder `--keep` keeps maps and what was
printed, and maps that are there go on from where they stand.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from topoloc import Localizer, TopoMetricMap, open_sequence
from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.localization.result import Localization

_WRONG_M, _WRONG_DEG = 0.5, 5.0


@dataclass(frozen=True)
class Cost:
    """Of one command: seconds of processor time, megabytes at most."""

    seconds: float
    peak_mb: float

    def __str__(self) -> str:
        return f"{self.seconds:.1f} s, {self.peak_mb:.0f} MB"


def run(*words: str | Path) -> Cost:
    """Run a command of topoloc in a process of its own. End the benchmark if it fails."""
    process = subprocess.Popen(
        [sys.executable, "-m", "topoloc", *map(str, words)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    assert process.stderr is not None
    said = process.stderr.read().decode()
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        sys.exit(f"topoloc {' '.join(map(str, words))}: {said.strip()}")
    return Cost(used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)


def asked(path: Path, pictures: Path, step: int) -> str:
    """How a map does on every `step`-th picture of a recording, in one line."""
    metres, degrees, num = list[float](), list[float](), 0
    sequence = open_sequence(pictures)
    with TopoMetricMap.load(path) as topomap:
        localizer = Localizer(topomap)
        for index in range(0, len(sequence), step):
            frame = sequence[index]
            result = localizer.localize(frame.image, frame.camera)
            num += 1
            if isinstance(result, Localization) and frame.world_from_cam is not None:
                metres.append(translation_error(frame.world_from_cam, result.world_from_cam))
                degrees.append(
                    float(np.degrees(rotation_error(frame.world_from_cam, result.world_from_cam)))
                )
    wrong = sum(m > _WRONG_M or d > _WRONG_DEG for m, d in zip(metres, degrees, strict=True))
    medians = (
        f"{100 * np.median(metres or [np.nan]):.2f} cm, {np.median(degrees or [np.nan]):.3f} deg"
    )
    return f"{len(metres)} of {num}, {wrong} wrong, {medians}"


def size(path: Path) -> str:
    with TopoMetricMap.load(path) as topomap:
        nodes, kilometres = topomap.summaries, topomap.length_m / 1e3
        of_session = [
            sum(node.session_id == session.session_id for node in nodes)
            for session in topomap.sessions
        ]
        num_points = sum(node.num_points for node in nodes) / len(nodes)
    at = f"{len(nodes)} nodes {of_session}, {num_points:.0f} landmarks a node"
    return (
        f"{path.stat().st_size / 1e6:.2f} MB ({path.stat().st_size / 1e6 / kilometres:.0f} MB a km"
        f" walked), {at}"
    )


class LivingMap:
    """The maps of one run: never updated, living, and the living one that is never pruned."""

    def __init__(self, args: argparse.Namespace, folder: Path) -> None:
        self.args, self.folder = args, folder
        self.never, self.living, self.unlimited = (
            folder / f"{name}.topo" for name in ("never", "living", "unlimited")
        )
        self.features = ["--features", args.features] if args.features else []
        self.settings = ["--config", args.settings] if args.settings else []
        self.updated = [self.living, self.unlimited] if args.unlimited else [self.living]
        if not self.never.exists():
            self.say(
                f"build {args.map_sequence}:"
                f" {run('build', args.map_sequence, self.never, *self.features)};"
                f" {size(self.never)}"
            )
        for path in self.updated:
            if not path.exists():
                path.write_bytes(self.never.read_bytes())
        self.budget = None if args.budget is None else args.budget * self.never.stat().st_size / 1e6

    def say(self, line: str) -> None:
        print(line, flush=True)
        with open(self.folder / "said.txt", "a") as said:
            said.write(line + "\n")

    def join(self, walk: str) -> None:
        path, _, light = walk.partition("=")
        first = open_sequence(path)[0]
        is_single = first.right is None and first.depth is None
        trajectory = self.args.single if is_single else self.args.trajectory
        words = ["--trajectory", trajectory, *(["--light", light] if light else []), *self.settings]
        costs = list[Cost]()
        for topo in self.updated:
            costs.append(run("update", topo, path, *words))
            self.say(f"{topo.stem} + {path} by {trajectory}: {costs[-1]}; {size(topo)}")
        if self.args.alone and not is_single:
            alone = run(
                "build",
                path,
                self.folder / "alone.topo",
                "--trajectory",
                trajectory,
                *self.features,
            )
            self.say(f"  alone: {alone}; update / build {costs[0].seconds / alone.seconds:.2f}")
        if self.args.prune or self.budget is not None:
            words = [] if self.budget is None else ["--max-mb", f"{self.budget:.3f}"]
            cost = run("prune", self.living, *words, *self.settings)
            self.say(
                f"  pruned {' '.join(words)}: {cost}; {size(self.living)}, {self.share():.2f} of"
                " the first map's bytes"
            )

    def share(self) -> float:
        return self.living.stat().st_size / self.never.stat().st_size

    def ask(self) -> None:
        for name, pictures in (entry.split("=", 1) for entry in self.args.ask):
            for topo in (self.never, *self.updated):
                self.say(f"  {name}, {topo.stem}: {asked(topo, Path(pictures), self.args.step)}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map_sequence")
    parser.add_argument("walks", nargs="*", metavar="WALK[=LIGHT]")
    parser.add_argument("--ask", nargs="+", default=[], metavar="NAME=SEQ")
    parser.add_argument("--step", type=int, default=1)
    parser.add_argument("--trajectory", default="slam")
    parser.add_argument("--single", default="map")
    parser.add_argument("--features")
    parser.add_argument("--settings", type=Path)
    parser.add_argument("--prune", action="store_true")
    parser.add_argument("--budget", type=float)
    parser.add_argument("--unlimited", action="store_true")
    parser.add_argument("--alone", action="store_true")
    parser.add_argument("--ask-each", action="store_true")
    parser.add_argument("--keep", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = args.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        maps = LivingMap(args, folder)
        for walk in args.walks:
            maps.join(walk)
            if args.ask_each:
                maps.ask()
        if not args.ask_each:
            maps.ask()


if __name__ == "__main__":
    main()
