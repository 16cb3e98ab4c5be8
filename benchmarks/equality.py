"""Run the same inputs with an old commit and with this source tree, and compare the answers.

    python benchmarks/equality.py OLD_COMMIT [--quick] [--shared ../shared] [--cache FOLDER]

Both sides run the command line in processes of their own on this machine. Reason, tile and node
must be equal; position, angle and probability may differ by 1e-6 (metres, radians). This tree
answers without its last step (`fast.toml`), which old commits had not. The old commit is unpacked
into a temporary folder and compiles its kernels there, which takes about half a minute.
`--cache FOLDER` keeps its answers, by commit. `--only CASE` runs one case and those before it.
The exit status is 1 on a difference.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tarfile
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from acceptance_jobs.answers import Comparison, compare_answers, kept
from acceptance_jobs.workplace import ROOT, JobError, last_line, read_lines, run

Words = tuple[object, ...]
Answers = dict[str, list[dict[str, Any]]]


@dataclass(frozen=True)
class Case:
    """Hold the commands of one comparison: preparation, then one that writes results to a file."""

    name: str
    prepare: tuple[Words, ...]
    query: Words
    results: str


def spread(folder: Path, pattern: str, number: int) -> list[Path]:
    """Return so many files, evenly chosen in their order."""
    files = sorted(folder.rglob(pattern))
    return [files[i * len(files) // number] for i in range(min(number, len(files)))]


def localize(name: str, where: str, *inputs: object, **options: object) -> tuple[Words, str]:
    """Return a command that localizes each image alone, and the name of its file of results."""
    words: list[object] = [word for key, value in options.items() for word in (f"--{key}", value)]
    return ("localize", where, *inputs, "--single", *words, "--json", f"{name}.jsonl"), (
        f"{name}.jsonl"
    )


def cases(data: Path, quick: bool) -> list[Case]:
    """Return the cases; the maps of earlier ones are there for later ones."""
    lab = ROOT / "src" / "topoloc" / "demo" / "lab"
    asked = [lab / name for name in ("day", "night", "other_camera", "street", "corridor")]
    demo = Case("demo", (("demo", "--out", "demo"),), *localize("lab", "demo/lab.topo", *asked))
    if not data.is_dir():
        return [demo]
    kitchen, street = data / "seven_scenes/kitchen", data / "kitti/sequences/street1"
    zed = data / "zed_lab"
    outside = spread(data / "ie_tower", "*.jpg", 30) + spread(data / "gardenspoint", "*.jpg", 15)
    outside += spread(data / "kitti/sequences/street2/image_0", "*.png", 15)
    colour = spread(kitchen, "*.color.jpg", 70)
    build_zed = ("build", zed / "session1", "zed.topo")
    build_kitchen = ("build", f"{kitchen}@0::2", "kitchen.topo", "--d-thresh", 0.5)
    build_street = ("build", f"{street}@0::2", "street.topo")
    if quick:
        few = localize("zed", "zed.topo", f"{zed}/session2@0:99:4")
        away = localize("outside", "zed.topo", *outside[::4], camera="unknown")
        return [demo, Case("zed", (build_zed,), *few), Case("out of map", (), *away)]
    tiles = ("zed.topo", "kitchen.topo", "street.topo")
    inside = [
        *colour[3::14],
        *spread(zed / "session2/image_0", "*.jpg", 6),
        outside[0],
        outside[-1],
    ]
    return [
        demo,
        Case("zed", (build_zed,), *localize("zed", "zed.topo", f"{zed}/session2")),
        Case("kitchen", (build_kitchen,), *localize("kitchen", "kitchen.topo", f"{kitchen}@1::2")),
        Case("street", (build_street,), *localize("street", "street.topo", f"{street}@1::2")),
        Case(
            "uncalibrated",
            (),
            *localize("uncalibrated", "kitchen.topo", *colour[1:60:2], camera="unknown"),
        ),
        Case("out of map", (), *localize("outside", "zed.topo", *outside, camera="unknown")),
        Case(
            "atlas",
            (("atlas", "create", "atlas", *tiles),),
            *localize("atlas", "atlas", *inside, camera="unknown"),
        ),
    ]


def answers_of(tree: Path, chosen: list[Case], timeout: float = 600) -> Answers:
    """Return the answers of a source tree to all cases.

    Raises:
        JobError: A command failed.
    """
    answers: Answers = {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for case in chosen:
            for words in (*case.prepare, case.query):
                command = [sys.executable, "-m", "topoloc", *words, *settings_of(tree, words)]
                code, out, err = run(command, folder, tree, timeout)
                if code != 0:
                    raise JobError(
                        f"{case.name}: exit status {code}: {last_line(err) or last_line(out)}"
                    )
            answers[case.name] = kept(read_lines(folder / case.results))
    return answers


def settings_of(tree: Path, words: Words) -> Words:
    """Return the options by which a tree with a last step answers without it, as it did before."""
    if words[0] != "localize" or not (tree / "src/topoloc/localization/exact").is_dir():
        return ()
    return ("--config", ROOT / "benchmarks" / "fast.toml")


def unpack(commit: str, folder: Path) -> Path:
    """Write the files of a commit to a folder."""
    archive = folder / "old.tar"
    git = ["git", "-C", str(ROOT), "archive", "--format=tar", f"--output={archive}", commit]
    subprocess.run(git, check=True)
    with tarfile.open(archive) as tar:
        tar.extractall(folder / "old", filter="data")
    archive.unlink()
    return folder / "old"


def old_answers(commit: str, chosen: list[Case], cache: Path | None) -> Answers:
    """Return the answers of an old commit, from the cache if they are there."""
    key = hashlib.sha256(repr([asdict(case) for case in chosen]).encode()).hexdigest()[:12]
    kept_at = cache / f"{commit[:12]}-{key}.json" if cache else None
    if kept_at and kept_at.exists():
        return json.loads(kept_at.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as temporary:
        answers = answers_of(unpack(commit, Path(temporary)), chosen)
    if kept_at:
        kept_at.parent.mkdir(parents=True, exist_ok=True)
        kept_at.write_text(json.dumps(answers), encoding="utf-8")
    return answers


def line(name: str, found: Comparison) -> str:
    """Return one line of the table."""
    largest = f"{found.position:9.1e} {found.angle:9.1e} {found.probability:9.1e}"
    return f"{name:14} {found.compared:7} {found.different:9} {largest}  {found.first}"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("old_commit")
    parser.add_argument("--quick", action="store_true")
    shared = Path(os.environ.get("TOPOLOC_SHARED", ROOT.parent / "shared"))
    parser.add_argument("--shared", type=Path, default=shared)
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--only", help="a case; those whose maps it needs run, too")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    git = ["git", "-C", str(ROOT), "rev-parse", "--verify", f"{arguments.old_commit}^{{commit}}"]
    commit = subprocess.run(git, check=True, capture_output=True, text=True).stdout.strip()
    chosen = cases((arguments.shared / "data").resolve(), arguments.quick)
    if arguments.only:
        names = [case.name for case in chosen]
        chosen = chosen[: names.index(arguments.only) + 1]
    try:
        old = old_answers(commit, chosen, arguments.cache)
        new = answers_of(ROOT, chosen)
    except JobError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    found = {case.name: compare_answers(old[case.name], new[case.name]) for case in chosen}
    print(f"old {commit[:12]}, new {ROOT}")
    print("case           answers different         m       rad         p  first difference")
    for name, comparison in found.items():
        print(line(name, comparison))
    if arguments.json:
        rows = {name: asdict(comparison) for name, comparison in found.items()}
        arguments.json.write_text(json.dumps(rows, indent=1))
    return int(any(comparison.different for comparison in found.values()))


if __name__ == "__main__":
    sys.exit(main())
