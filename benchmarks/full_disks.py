"""Run every command that writes files on full disks and with few file handles.

    python benchmarks/full_disks.py FIRST SECOND [--only NAME ...] [--room KB ...] [--handles N ...]

FIRST and SECOND are stereo recordings with true poses of one place. Each command runs on a small
disk in memory, in a name space of mounts (`unshare -rm`). The disk has room for the files there
and a little more, from nothing on, in steps of 100 kB, until the command succeeds twice. In a
second row the folder for temporary files (TMPDIR) is that disk. In a third one the limit of open
files is 5 to 64. `--room` and `--handles` name other limits.

A command must end with status 0 and the files that it leaves on a large disk. Or it ends with
status 1 and one line, all files are as before, byte by byte, and there is no other one, but for
files that the line names as written. All else is a finding, and different ones of a row are
printed. The exit status is 1 if there is one.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from topoloc.apps.cli import COMMANDS, main as run_command
from topoloc.atlas.atlas import Atlas
from topoloc.errors import TopolocError
from topoloc.mapping.storage.integrity_check import find_map_damage

LARGE_KB = 100_000
FIRST_KB = (0, 4, 8, 12, 16, 24, 32, 64)
"""Room in kB beside the files that are there. After these, steps of 100 follow."""
MAX_KB = 8000
NUM_IN_A_ROW = 2
MAX_S = 300


@dataclass(frozen=True)
class Case:
    """A command line, in a folder with these files or folders. FIRST and SECOND in it are the
    recordings, VIEW is an image."""

    line: str
    files: tuple[str, ...] = ()


_CAMERA = "--camera 261,261,336,188"
CASES = {
    "build": Case("build FIRST new.topo --features surf --json new.json", ("second.topo",)),
    "build over": Case("build FIRST first.topo --features surf", ("first.topo",)),
    "slam": Case("slam FIRST out.tum --json out.json", ("out.tum",)),
    "update": Case("update first.topo SECOND --trajectory truth", ("first.topo",)),
    "prune": Case("prune first.topo --max-mb 0.8 --json out.json", ("first.topo",)),
    "undo": Case("undo first.topo", ("first.topo",)),
    "merge": Case("merge first.topo second.topo new.topo", ("first.topo", "second.topo")),
    "merge over": Case(
        "merge first.topo second.topo old.topo", ("first.topo", "second.topo", "old.topo")
    ),
    "georeference": Case("georeference first.topo --origin 50.8,4.7,30,0", ("first.topo",)),
    "certify": Case(
        "certify first.topo --out-of-map SECOND --json out.json --report out.html", ("first.topo",)
    ),
    "atlas create": Case(
        "atlas create new first.topo second.topo --world w --json out.json",
        ("first.topo", "second.topo"),
    ),
    "atlas add": Case("atlas add atlas second.topo", ("atlas", "second.topo")),
    "atlas add over": Case("atlas add atlas first.topo --replace", ("atlas", "first.topo")),
    "atlas remove": Case("atlas remove atlas first", ("atlas",)),
    "atlas join": Case("atlas join pair", ("pair",)),
    "atlas georeference": Case(
        "georeference atlas --tile first --origin 50.8,4.7,30,0", ("atlas",)
    ),
    "atlas prune": Case("prune atlas --max-mb 0.8", ("atlas",)),
    "atlas undo": Case("undo atlas --tile first", ("atlas",)),
    "atlas merge": Case("merge atlas second.topo new", ("atlas", "second.topo")),
    "export colmap": Case("export first.topo out --format colmap", ("first.topo",)),
    "export colmap over": Case("export first.topo colmap", ("first.topo", "colmap")),
    "export ply": Case("export first.topo out.ply --json out.json", ("first.topo",)),
    "export mcap": Case("export first.topo out.mcap", ("first.topo",)),
    "export geojson": Case("export atlas out.geojson", ("atlas",)),
    "localize": Case("localize first.topo SECOND --json out.json --tum out.tum", ("first.topo",)),
    "localize --save-camera": Case(
        "localize first.topo FIRST --single --camera unknown --save-camera out.tum",
        ("first.topo", "out.tum"),
    ),
    "evaluate": Case(
        "evaluate first.topo SECOND --json out.json --report out.html", ("first.topo",)
    ),
    "explain": Case(
        f"explain first.topo VIEW {_CAMERA} --out out.html --json out.json", ("first.topo",)
    ),
    "view": Case("view first.topo --out out.html", ("first.topo",)),
    "view --json": Case("view first.topo --json out.json", ("first.topo",)),
    "info": Case("info first.topo --json out.json", ("first.topo",)),
    "config": Case("config build", ()),
}


def make_inputs(folder: Path, first: str, second: str, names: set[str]) -> None:
    """Write the named files: two maps, the first one with two kept files, atlases and others."""
    origin = "georeference first.topo --origin 50.8,4.7,30"
    (folder / "out.tum").write_text("a file that is there already\n")
    is_first = bool(names & {"first.topo", "atlas", "pair"})
    is_second = bool(names & {"second.topo", "old.topo", "pair", "colmap"})
    for line, is_needed in {
        f"build {first} first.topo --features surf": is_first,
        f"build {second} second.topo --features surf": is_second,
        f"{origin},0": is_first,
        f"{origin},90": is_first,
        "atlas create atlas first.topo": "atlas" in names,
        "atlas create pair first.topo second.topo": "pair" in names,
        "export second.topo colmap --format colmap": "colmap" in names,
    }.items():
        if is_needed:
            command = [sys.executable, "-m", "topoloc", *line.split()]
            subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)
    if is_second:
        shutil.copy(folder / "second.topo", folder / "old.topo")


@dataclass(frozen=True)
class Limits:
    """Limits of one run: room in kB beside the files on the disk or in TMPDIR, and file handles."""

    disk_kb: int = LARGE_KB
    tmp_kb: int = LARGE_KB
    handles: int | None = None

    def __str__(self) -> str:
        if self.handles is not None:
            return f"{self.handles} handles"
        return f"disk {self.disk_kb} kB" if self.tmp_kb == LARGE_KB else f"TMPDIR {self.tmp_kb} kB"


class Place:
    """Two small disks: one for the files and one for temporary files."""

    def __init__(self, inputs: Path, folder: Path, words: dict[str, str]) -> None:
        self._inputs, self._words = inputs, words
        self._usual = set[str]()
        self.disk, self._tmp, self._errors = (folder / one for one in ("d", "tmp", "errors"))
        self.disk.mkdir()
        self._tmp.mkdir()

    def run(self, case: Case, limits: Limits) -> tuple[str, str, dict[str, bytes]]:
        """Run a command. Return "ok", "refused" or "finding", a text, and the files after it. Lines
        that the command prints on standard error without limits are no errors later."""
        for folder in (self.disk, self._tmp):
            _mount(folder, LARGE_KB)
        try:
            for name in case.files:
                self._copy(name)
            used = shutil.disk_usage(self.disk).used // 1024
            _mount(self.disk, used + limits.disk_kb, "remount")
            _mount(self._tmp, max(limits.tmp_kb, 4), "remount")
            if limits.tmp_kb == 0:
                (self._tmp / "filler").write_bytes(bytes(4096))
            before = _read_folder(self.disk)
            status = self._run(case, limits)
            after = _read_folder(self.disk)
            lines = self._errors.read_text().splitlines()
            left = [one.name for one in self._tmp.iterdir() if one.name != "filler"]
            if limits == Limits():
                self._usual = {line for line in lines if not line.startswith("error: ")}
            lines = [line for line in lines if line not in self._usual]
            text = _find_fault(status, lines, before, after, left)
            outcome = "finding" if text else "ok" if status == 0 else "refused"
            return outcome, text or " ".join(lines), after
        finally:
            for folder in (self.disk, self._tmp):
                subprocess.run(["umount", str(folder)], check=True)

    def _copy(self, name: str) -> None:
        if (self._inputs / name).is_dir():
            shutil.copytree(self._inputs / name, self.disk / name)
        for one in self._inputs.glob(f"{name}*"):
            if one.is_file():
                shutil.copy(one, self.disk)

    def _run(self, case: Case, limits: Limits) -> int:
        """Run the command in a copy of this process, which has loaded all libraries."""
        if (child := os.fork()) == 0:
            status = 99
            try:
                os.chdir(self.disk)
                os.environ["TMPDIR"] = tempfile.tempdir = str(self._tmp)
                signal.alarm(MAX_S)
                for number, path in ((1, os.devnull), (2, str(self._errors))):
                    opened = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
                    os.dup2(opened, number)
                os.closerange(3, 1000)
                if limits.handles is not None:
                    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
                    resource.setrlimit(resource.RLIMIT_NOFILE, (limits.handles, most))
                words = [self._words.get(word, word) for word in case.line.split()]
                status = run_command(words)
            except SystemExit as ended:
                status = int(ended.code or 0)
            except BaseException:  # as the interpreter does
                import traceback

                traceback.print_exc()
                status = 1
            finally:
                sys.stderr.flush()
                os._exit(status)
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def _mount(folder: Path, kb: int, *options: str) -> None:
    joined = ",".join([*options, f"size={kb}k"])
    subprocess.run(["mount", "-t", "tmpfs", "-o", joined, "tmpfs", str(folder)], check=True)


def _read_folder(folder: Path) -> dict[str, bytes]:
    """Return the content of each file by its name, and of each folder nothing."""
    return {
        str(one.relative_to(folder)): one.read_bytes() if one.is_file() else b""
        for one in folder.rglob("*")
    }


def _find_fault(
    status: int,
    lines: list[str],
    before: dict[str, bytes],
    after: dict[str, bytes],
    left: list[str],
) -> str:
    """Return the fault at the end of a command, "" if there is none."""
    said = [line for line in lines if not line.startswith("warning: ")]
    if status not in (0, 1):
        return f"status {status}: {' '.join(said)[-300:]}"
    if left:
        return f"status {status}, left in TMPDIR: {', '.join(left)}"
    if status == 0:
        return f"status 0 and lines: {' '.join(said)[-300:]}" if said else ""
    if len(said) != 1 or not said[0].startswith("error: "):
        return f"{len(said)} lines: {' '.join(said)[-300:]}"
    changed = [name for name in before if after.get(name) != before[name]]
    new = [name for name in after if name not in before]
    written = said[0].partition("(already written: ")[2].rstrip(")").split(", ")
    if set(changed + new).difference(written):
        return f"changed: {', '.join(changed)}; new: {', '.join(new)}; {said[0]}"
    return "" if not re.search(r"sqlite|\.part\b", said[0]) else f"inner names: {said[0]}"


def _names(files: dict[str, bytes]) -> list[str]:
    """Return the names of files without the digests in them."""
    return sorted(re.sub("[0-9a-f]{12,}", "*", name) for name in files)


def _without_digits(text: str) -> str:
    return re.sub("[0-9a-f]{12}|[0-9]", "", text)


def _find_damage(folder: Path, files: dict[str, bytes]) -> str:
    """Return the first fault of the maps and atlases among the files, written to a folder."""
    try:
        for name, data in files.items():
            if data:
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (folder / name).write_bytes(data)
        for path in folder.rglob("*.topo"):
            if damage := find_map_damage(path):
                return f"{path.name}: {damage[0]}"
        for path in folder.rglob("atlas.json"):
            atlas = Atlas.open(str(path.parent))
            for name in atlas.select_tiles():
                if problem := atlas.find_problem(name):
                    return problem
        return ""
    except TopolocError as error:
        return str(error)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _rows(sizes: Sequence[int], handles: Sequence[int]) -> Iterator[tuple[str, list[Limits]]]:
    yield "disk", [Limits(disk_kb=kb) for kb in sizes]
    yield "TMPDIR", [Limits(tmp_kb=kb) for kb in sizes]
    yield "handles", [Limits(handles=number) for number in handles]


def run_inside(
    folder: Path, words: dict[str, str], names: list[str], rows: tuple[Sequence[int], Sequence[int]]
) -> int:
    """Run the commands, print findings and a table. Return the number of findings."""
    warnings.simplefilter("ignore")
    for module, _ in COMMANDS.values():
        __import__(module)
    _load_libraries()
    (folder / "disks").mkdir()
    place, total = Place(folder / "inputs", folder / "disks", words), 0
    print("| command | limit | ok | refused | findings |\n|---|---|---|---|---|")
    for name in names:
        case = CASES[name]
        outcome, text, whole = place.run(case, Limits())
        if outcome != "ok":
            raise SystemExit(f"topoloc {case.line} does not work: {text}")
        for row, all_limits in _rows(*rows):
            counts, known, in_a_row = Counter[str](), set[str](), 0
            for limits in all_limits:
                outcome, text, files = place.run(case, limits)
                if outcome == "ok":
                    damage = _find_damage(folder / "looked_at", files)
                    other = set(_names(files)) ^ set(_names(whole))
                    text = damage or (f"other files: {', '.join(other)}" if other else "")
                    outcome = "finding" if text else "ok"
                counts[outcome] += 1
                if outcome == "finding" and _without_digits(text) not in known:
                    known.add(_without_digits(text))
                    print(f"{name}, {limits}: {text[:500]}", flush=True)
                in_a_row = in_a_row + 1 if outcome == "ok" else 0
                if in_a_row == NUM_IN_A_ROW:
                    break
            numbers = " | ".join(str(counts[one]) for one in ("ok", "refused", "finding"))
            print(f"| {name} | {row} | {numbers} |", flush=True)
            total += counts["finding"]
    return total


def _load_libraries() -> None:
    """Import what commands import when they run, so that few handles meet the work itself."""
    import cv2  # noqa: F401
    import faiss  # noqa: F401
    import matplotlib.pyplot  # noqa: F401

    import topoloc
    from topoloc.apps.export import colmap, foxglove  # noqa: F401
    from topoloc.apps.report import certificate_page, explanation_page, report  # noqa: F401

    for name in topoloc.__all__:
        getattr(topoloc, name)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("first")
    parser.add_argument("second")
    parser.add_argument("--only", nargs="+", default=list(CASES), choices=list(CASES))
    sizes = [*FIRST_KB, *range(100, MAX_KB, 100)]
    parser.add_argument("--room", nargs="+", type=int, default=sizes, help="kB on a disk")
    parser.add_argument("--handles", nargs="+", type=int, default=range(5, 65), help="open files")
    parser.add_argument("--inside", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    words = {"FIRST": os.path.abspath(args.first), "SECOND": os.path.abspath(args.second)}
    if args.inside is not None:
        words["VIEW"] = str(args.inside / "view.jpg")
        found = run_inside(args.inside, words, args.only, (args.room, args.handles))
        print(json.dumps({"findings": found}))
        return int(found > 0)
    with tempfile.TemporaryDirectory(prefix="full-disks-") as name:
        folder = Path(name)
        (folder / "inputs").mkdir()
        needed = {name for case in args.only for name in CASES[case].files}
        make_inputs(folder / "inputs", words["FIRST"], words["SECOND"], needed)
        _write_view(words["FIRST"], folder / "view.jpg")
        command = ["unshare", "-rm", sys.executable, *sys.argv, "--inside", name]
        return subprocess.run(command, check=False).returncode


def _write_view(recording: str, path: Path) -> None:
    import cv2

    from topoloc import open_sequence

    cv2.imwrite(str(path), open_sequence(recording)[0].image)


if __name__ == "__main__":
    sys.exit(main())
