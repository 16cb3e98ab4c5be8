"""Run the same inputs with an old commit and with this source tree, and compare the answers.

    python benchmarks/equality.py OLD_COMMIT [--quick] [--tree PATH] [--shared ../shared]
        [--cache FOLDER] [--only CASE ...] [--json FILE]

Both sides run the command line in processes of their own on this machine. Reason, state, tile and
node must be equal; position, angle and probability may differ by 1e-6 (metres, radians), and
covariances by 1e-6 of their diagonals. If the old commit had no last step, this tree answers
without it (`fast.toml`), covariances are left out, and there are fewer cases. `--tree` is another
source tree instead of this one. The old commit is unpacked into a temporary folder and compiles its
kernels there, which takes about half a minute. `--cache FOLDER` keeps its answers, by commit and
case. `--only CASE` runs one case and prepares those before it. The exit status is 1 on a
difference.
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
from dataclasses import asdict
from pathlib import Path
from typing import Any

from acceptance_jobs.answers import Comparison, compare_answers, kept, without_appearance
from acceptance_jobs.equality_cases import Case, Words, cases
from acceptance_jobs.varied_images import vary
from acceptance_jobs.workplace import ROOT, JobError, last_line, read_lines, run

Answers = dict[str, list[dict[str, Any]]]


def answers_of(
    tree: Path, chosen: list[Case], wanted: list[str], is_full: bool, timeout: float = 1800
) -> Answers:
    """Return the answers of a source tree to the wanted cases; all are prepared.

    Raises:
        JobError: A command failed.
    """
    answers: Answers = {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for case in chosen:
            for words in case.prepare:
                run_words(tree, case, words, folder, is_full, timeout)
            if case.name in wanted:
                out = run_words(tree, case, case.query, folder, is_full, timeout)
                path = folder / case.results
                if not path.exists():  # `follow` prints its answers
                    path.write_text(out, encoding="utf-8")
                found = kept(read_lines(path))
                answers[case.name] = found if is_full else without_appearance(found)
    return answers


def run_words(
    tree: Path, case: Case, words: Words, folder: Path, is_full: bool, timeout: float
) -> str:
    """Return the standard output of a command of topoloc, or make images."""
    if words[0] == "vary":
        vary(str(words[1]), int(str(words[2])), folder / str(words[3]))
        return ""
    options = () if is_full else settings_of(tree, words)
    command = [sys.executable, "-m", "topoloc", *words, *options]
    code, out, err = run(command, folder, tree, timeout)
    if code != 0:
        raise JobError(f"{case.name}: exit status {code}: {last_line(err) or last_line(out)}")
    return out


def has_last_step(tree: Path) -> bool:
    """Return whether the queries of a source tree end with a last step."""
    return (tree / "src/topoloc/localization/exact").is_dir()


def settings_of(tree: Path, words: Words) -> Words:
    """Return the options by which a tree with a last step answers without it, as it did before."""
    if words[0] != "localize" or not has_last_step(tree):
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


class Kept:
    """Keep the answers of an old commit in a folder, by case and by the commands before it."""

    def __init__(self, folder: Path, commit: str, chosen: list[Case], data: Path) -> None:
        self._paths = dict[str, Path]()
        digest = hashlib.sha256()
        for case in chosen:
            words = repr((case.prepare, asdict(case)))
            digest.update(words.replace(str(ROOT), "ROOT").replace(str(data), "DATA").encode())
            name = case.name.replace(", ", "-").replace(" ", "-")
            self._paths[case.name] = folder / f"{commit[:12]}-{name}-{digest.hexdigest()[:12]}.json"

    def read(self) -> Answers:
        """Return the answers that are there."""
        return {
            name: json.loads(path.read_text(encoding="utf-8"))
            for name, path in self._paths.items()
            if path.exists()
        }

    def write(self, answers: Answers) -> None:
        """Add answers."""
        for name, found in answers.items():
            self._paths[name].parent.mkdir(parents=True, exist_ok=True)
            self._paths[name].write_text(json.dumps(found), encoding="utf-8")


def old_answers(
    tree: Path, chosen: list[Case], wanted: list[str], cache: Kept | None, is_full: bool
) -> Answers:
    """Return the answers of an old source tree, from the cache if they are there."""
    answers = cache.read() if cache else {}
    missing = [name for name in wanted if name not in answers]
    if missing:
        found = answers_of(tree, chosen, missing, is_full)
        answers |= found
        if cache:
            cache.write(found)
    return answers


def line(name: str, found: Comparison) -> str:
    """Return one line of the table."""
    largest = f"{found.position:9.1e} {found.angle:9.1e} {found.probability:9.1e}"
    largest += f" {found.covariance:10.1e}"
    return f"{name:26} {found.compared:7} {found.different:9} {largest}  {found.first}"


def compare_trees(
    arguments: argparse.Namespace, commit: str, old: Path, data: Path
) -> dict[str, Comparison]:
    """Return the comparison of each wanted case."""
    is_full = has_last_step(old)
    chosen = cases(data, arguments.quick, is_full)
    names = [case.name for case in chosen]
    wanted = arguments.only or names
    chosen = chosen[: max(names.index(name) for name in wanted) + 1]
    cache = Kept(arguments.cache, commit, chosen, data) if arguments.cache else None
    before = old_answers(old, chosen, wanted, cache, is_full)
    now = answers_of(arguments.tree.resolve(), chosen, wanted, is_full)
    return {name: compare_answers(before[name], now[name]) for name in names if name in wanted}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("old_commit")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--tree", type=Path, default=ROOT, help="source tree with new answers")
    shared = Path(os.environ.get("TOPOLOC_SHARED", ROOT.parent / "shared"))
    parser.add_argument("--shared", type=Path, default=shared)
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--only", action="append", metavar="CASE", help="several times: several")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    git = ["git", "-C", str(ROOT), "rev-parse", "--verify", f"{arguments.old_commit}^{{commit}}"]
    commit = subprocess.run(git, check=True, capture_output=True, text=True).stdout.strip()
    data = (arguments.shared / "data").resolve()
    try:
        with tempfile.TemporaryDirectory() as temporary:
            old = unpack(commit, Path(temporary))
            found = compare_trees(arguments, commit, old, data)
    except JobError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"old {commit[:12]}, new {arguments.tree.resolve()}")
    columns = f"answers different {'m':>9} {'rad':>9} {'p':>9} {'covariance':>10}"
    print(f"{'case':26} {columns}  first difference")
    for name, comparison in found.items():
        print(line(name, comparison))
    if arguments.json:
        rows = {name: asdict(comparison) for name, comparison in found.items()}
        arguments.json.write_text(json.dumps(rows, indent=1))
    return int(any(comparison.different for comparison in found.values()))


if __name__ == "__main__":
    sys.exit(main())
