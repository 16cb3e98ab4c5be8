"""The jobs that take minutes: training, the paper's command, damaged files, the slow tests."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator

from .figures import Figure
from .workplace import ROOT, JobError, Workplace, last_line, need_module, run

WEIGHTS = "squeezenet1_1-imagenet-features.pth"
NUM_DAMAGED = 500


def train(work: Workplace) -> Iterator[Figure]:
    """Train cnn-nn on a map of 60 images, and query the map with it."""
    need_module("torch")
    path = work.folder / "zed.topo"
    work.topoloc("build", work.data("zed_lab/session1@0:60"), path)
    stored = work.shared / "weights" / WEIGHTS
    weights = ("--weights", stored if stored.exists() else "scratch")
    trained = work.answer("train", path, "--coarse", "cnn-nn", *weights)
    yield Figure("cnn-nn: the map has it", int(trained["name"] == "cnn-nn"), "at least")
    session = work.data("zed_lab/session2@0:60:4")
    lines = work.answer("localize", path, session, "--single", "--coarse", "cnn-nn")
    found = sum(line["localized"] for line in lines)
    yield Figure(f"cnn-nn: localized of {len(lines)}", found, "at least")


def paper(work: Workplace) -> Iterator[Figure]:
    """Run the paper's command as a user types it."""
    need_module("torch")
    out = work.folder / "paper"
    work.topoloc("benchmark", "paper", "--quick", "--out", out, timeout=580)
    results = json.loads((out / "results.json").read_text(encoding="utf-8"))
    for table in ("accuracy", "nodes", "peers", "ablation"):
        yield Figure(f"rows of the table {table}", len(results[table]), "at least")
    ours = [row for row in results["accuracy"] if row["method"] == "surf-vlad"]
    yield Figure("surf-vlad: localized", sum(row["num_localized"] for row in ours), "at least")
    page = (out / "report.html").stat().st_size
    yield Figure("report.html is not empty", int(page > 10_000), "at least")


def fuzz(work: Workplace) -> Iterator[Figure]:
    """Read damaged files of every kind; kill edits."""
    small = work.folder / "small.topo"
    work.topoloc("build", work.data("zed_lab/session1@0:40:4"), small, "--features", "surf")
    fuzz = [sys.executable, ROOT / "benchmarks" / "fuzz.py", "--inputs", NUM_DAMAGED]
    code, out, err = run(fuzz, work.folder, timeout=900)
    rows = [line.split("|")[1:-1] for line in out.splitlines() if line.startswith("| ")]
    if not rows:
        raise JobError(f"fuzz.py: exit status {code}: {last_line(err) or last_line(out)}")
    for k, outcome in enumerate(cell.strip() for cell in rows[0]):
        if outcome in ("traceback", "hang", "crash", "memory"):
            count = sum(int(row[k].replace(",", "")) for row in rows[1:])
            yield Figure(f"damaged inputs, {NUM_DAMAGED} of each kind: {outcome}", count, "at most")
    yield _of_script(
        work, "killed edits of 50: broken or left", "kill_edits.py", small, "--kills", 50
    )


def test_slow(work: Workplace) -> Iterator[Figure]:
    """Run the slow tests, but for the paper's command, which is the job `paper`."""
    need_module("pytest")
    words = [sys.executable, "-m", "pytest", "-m", "slow", "-x", "-p", "no:cacheprovider"]
    words += ["--ignore", "tests/paper/test_benchmark_command.py"]
    code, out, err = run(words, ROOT, timeout=1800)
    if code != 0:
        raise JobError(last_line(out) or last_line(err))
    yield Figure("make test-slow passes", int(code == 0), "at least")


def _of_script(work: Workplace, name: str, script: str, *words: object) -> Figure:
    """Run a script of benchmarks/ and count its findings."""
    command = [sys.executable, ROOT / "benchmarks" / script, *words]
    code, out, err = run(command, work.folder, timeout=500)
    counts = [
        int(number)
        for number in re.findall(r"(\d+) (?:findings|times broken|times something)", out)
    ]
    if not counts:
        raise JobError(f"{script}: exit status {code}: {last_line(err) or last_line(out)}")
    return Figure(name, max(sum(counts), int(code != 0)), "at most")
