"""Edits of a map that are killed at random moments: is the map ever broken, is anything left lying
about?

    python benchmarks/kill_edits.py MAP [--kills 200] [--within 2]
    python benchmarks/kill_edits.py MAP --command-lines SEQ OTHER_MAP [--kills 60]

A child edits a copy of MAP without end, every third time taking the edit back. After each kill the
map is looked at from end to end, all that can be undone is undone, and one more edit is made; then
no file but the map may be there. Exit status 1 where anything was wrong.

With `--command-lines` whole processes are killed instead, in turns: `topoloc update MAP SEQ`,
`prune --max-mb` to 90 % of the file, `undo` of an update, `merge MAP OTHER_MAP OUT` over a file
that is there. Each is let run to its end once, and killed at a moment of the time that this took.
The map, and OUT, must be the one before or the one after, to the byte, and nothing but kept
files of the map may be there after one more edit; what processes leave in the folder for temporary
files counts, too.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from topoloc.mapping.edit import edit_map, undo_edit
from topoloc.mapping.storage.integrity_check import find_map_damage
from topoloc.mapping.storage.kept_files import find_kept_files


def edit_without_end(path: Path) -> None:
    """Edit the map without end, in the child process."""
    print("ready", flush=True)
    for k in range(100_000):
        with edit_map(path) as edit:
            edit.commit(edit.topomap, f"edit {k}", {"k": k})
        if k % 3 == 2:
            undo_edit(path)


def kill_transactions(path: Path, kills: int, within_s: float) -> Counter[str]:
    """Kills of a process that edits the map at `path`."""
    rng, counts = np.random.default_rng(0), Counter[str]()
    for _ in range(kills):
        with subprocess.Popen(
            [sys.executable, __file__, str(path), "--edit-without-end"], stdout=subprocess.PIPE
        ) as child:
            assert child.stdout is not None
            child.stdout.readline()
            time.sleep(rng.uniform(0.0, within_s))
            child.send_signal(signal.SIGKILL)
        counts["broken"] += bool(find_map_damage(path))
        while find_kept_files(path):
            undo_edit(path)
            counts["undone"] += 1
        counts["broken"] += bool(find_map_damage(path))
        _one_more_edit(path)
        counts["left"] += [one.name for one in path.parent.iterdir()] != [path.name]
    print(f"{kills} kills, {counts['undone']} edits undone afterwards: {_said(counts)}")
    return counts


@dataclass(frozen=True)
class KilledCommand:
    """A command line with the files that it begins with, by their names; `target` is the one that
    it writes."""

    words: list[str]
    files: dict[str, bytes]
    target: str = "map.topo"
    after: dict[str, bytes] = field(default_factory=dict)
    seconds: float = 0.0

    def prepare(self, folder: Path) -> None:
        """The folder as it is before."""
        shutil.rmtree(folder, ignore_errors=True)
        (folder / "temporary").mkdir(parents=True)
        for name, data in self.files.items():
            (folder / name).write_bytes(data)

    def start(self, folder: Path) -> subprocess.Popen[bytes]:
        words = [sys.executable, "-m", "topoloc", *self.words]
        environment = os.environ | {
            "TMPDIR": str(folder / "temporary"),
            "SOURCE_DATE_EPOCH": "1700000000",
        }
        return subprocess.Popen(
            words, cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )

    def finished(self, folder: Path) -> KilledCommand:
        """Return the command with its output files and its duration if it is not killed."""
        self.prepare(folder)
        start = time.perf_counter()
        if self.start(folder).wait() != 0:
            raise SystemExit(f"topoloc {' '.join(self.words)} does not work")
        after = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
        return KilledCommand(
            self.words, self.files, self.target, after, time.perf_counter() - start
        )


def kill_command_lines(
    given: Path, sequence: str, other: Path, kills: int, folder: Path
) -> Counter[str]:
    """Kills of `update`, `prune`, `undo` and `merge` in turns."""
    built = {"map.topo": given.read_bytes()}
    size = 0.9 * len(built["map.topo"]) / 1e6
    update = KilledCommand(["update", "map.topo", sequence], built).finished(folder)
    prune = KilledCommand(["prune", "map.topo", "--max-mb", f"{size:.4f}"], built).finished(folder)
    undo = KilledCommand(["undo", "map.topo"], update.after).finished(folder)
    pair = built | {"other.topo": other.read_bytes(), "out.topo": prune.after["map.topo"]}
    merge = KilledCommand(
        ["merge", "map.topo", "other.topo", "out.topo"], pair, "out.topo"
    ).finished(folder)
    rng, total = np.random.default_rng(0), Counter[str]()
    for command in (update, prune, undo, merge):
        counts = Counter[str]()
        for _ in range(kills // 4):
            _kill_once(command, folder, rng.uniform(0.0, 1.1 * command.seconds), counts)
        print(
            f"{command.words[0]:7} {command.seconds:.1f} s, {kills // 4} kills: {counts['before']}"
            " times the one before, ",
            end="",
        )
        print(f"{counts['after']} times the one after, {_said(counts)}", flush=True)
        total += counts
    return total


def _kill_once(command: KilledCommand, folder: Path, seconds: float, counts: Counter[str]) -> None:
    command.prepare(folder)
    with command.start(folder) as child:
        time.sleep(seconds)
        child.send_signal(signal.SIGKILL)
    found = {name: (folder / name).read_bytes() for name in {command.target, "map.topo"}}
    is_before = all(data == command.files[name] for name, data in found.items())
    is_after = all(data == command.after[name] for name, data in found.items())
    counts["before"] += is_before
    counts["after"] += is_after and not is_before
    counts["broken"] += (not is_before and not is_after) or bool(
        find_map_damage(folder / command.target)
    )
    _one_more_edit(folder / command.target)
    of_target = [one.name for one in find_kept_files(folder / command.target)]
    kept = {*command.files, *of_target, command.target, "temporary"}
    left = [path.name for path in folder.rglob("*") if path.name not in kept]
    counts["left"] += bool(left)
    if left:
        print(f"left by {command.words[0]}, killed after {seconds:.2f} s: {', '.join(left)}")


def _one_more_edit(path: Path) -> None:
    with edit_map(path) as edit:
        edit.commit(edit.topomap, "after")
    undo_edit(path)


def _said(counts: Counter[str]) -> str:
    return f"{counts['broken']} times broken, {counts['left']} times something left"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map", type=Path)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument(
        "--within",
        type=float,
        default=2.0,
        help="seconds after which a process that edits is killed at the latest",
    )
    parser.add_argument("--command-lines", nargs=2, metavar=("SEQ", "OTHER_MAP"))
    parser.add_argument("--edit-without-end", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.edit_without_end:
        edit_without_end(args.map)
        return 0
    with tempfile.TemporaryDirectory() as folder:
        if args.command_lines:
            sequence, other = args.command_lines
            counts = kill_command_lines(
                args.map, os.path.abspath(sequence), Path(other), args.kills, Path(folder) / "place"
            )
        else:
            counts = kill_transactions(
                Path(shutil.copy(args.map, Path(folder) / "map.topo")), args.kills, args.within
            )
    return int(counts["broken"] + counts["left"] > 0)


if __name__ == "__main__":
    sys.exit(main())
