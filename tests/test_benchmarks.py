"""Benchmarks import names that exist, and the judge compares. Most run too long for a test."""

from __future__ import annotations

import ast
import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
FILES = sorted(BENCHMARKS.rglob("*.py"))


@pytest.mark.parametrize("path", FILES, ids=[str(path.relative_to(BENCHMARKS)) for path in FILES])
def test_a_benchmark_imports_names_that_exist(path: Path):
    missing = list[str]()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("topoloc"):
            module = importlib.import_module(str(node.module))
            for name in (one.name for one in node.names):
                if not hasattr(module, name):
                    try:
                        importlib.import_module(f"{node.module}.{name}")
                    except ImportError:
                        missing.append(f"{node.module}.{name}")
    assert missing == []


def test_folders_of_tests_that_benchmarks_use_exist():
    for path in FILES:
        for line in path.read_text(encoding="utf-8").splitlines():
            if line.startswith("TESTS = "):
                parts = [part.strip(' "') for part in line.split("/")[1:]]
                assert (BENCHMARKS.parent / Path(*parts)).is_dir(), f"{path.name}: {line}"


TINY = '''"""Run the judge with one table, whose figures stand in a file."""

import json, runpy, sys
from pathlib import Path

sys.path.insert(0, sys.argv[1])
from acceptance_jobs.figures import Figure
from judge_tables import registry


def tiny(bench):
    with (bench.work / "runs.txt").open("a") as file:
        file.write("run ")
    figures = json.loads((bench.work / "figures.json").read_text())
    yield from (Figure(*row) for row in figures)


registry.TABLES.clear()
registry.TABLES["tiny"] = registry.Table(tiny)
script, sys.argv = sys.argv[1] + "/judge.py", ["judge.py", *sys.argv[2:]]
runpy.run_path(script, run_name="__main__")
'''


class TinyJudge:
    """Run `benchmarks/judge.py` with one table of given figures, in a process of its own."""

    def __init__(self, folder: Path) -> None:
        self.work = folder / "work"
        self.source = folder / "tree" / "src" / "topoloc" / "a.py"
        self._script = folder / "tiny.py"
        self._script.write_text(TINY, encoding="utf-8")
        self.work.mkdir()
        self.source.parent.mkdir(parents=True)
        self.source.write_text("1\n", encoding="utf-8")

    def set_figures(self, right: int, wrong: int, *more: object) -> None:
        rows = [("right", right, "at least", "", 2), ("wrong", wrong, "at most"), *more]
        (self.work / "figures.json").write_text(json.dumps(rows), encoding="utf-8")

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        folders = "--work", str(self.work), "--judged", str(self.work / "judged")
        options = "--tree", str(self.source.parents[2]), *folders
        command = [sys.executable, str(self._script), str(BENCHMARKS), *options, *words]
        return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)

    @property
    def num_runs(self) -> int:
        return len((self.work / "runs.txt").read_text(encoding="utf-8").split())


def test_the_judge_goes_on_where_it_stopped_and_names_what_is_worse(tmp_path: Path):
    judge = TinyJudge(tmp_path)
    judge.set_figures(50, 1)
    assert judge.run("--write").returncode == 0
    done = judge.run()
    assert done.returncode == 0, done.stdout + done.stderr
    assert judge.num_runs == 1, "a finished table is not run again"
    judge.set_figures(48, 1)
    judge.source.write_text("2\n", encoding="utf-8")
    done = judge.run()
    assert (done.returncode, judge.num_runs) == (0, 2), "two fewer are within the slack"
    right = next(line for line in done.stdout.splitlines() if " right " in line)
    assert right.split() == ["tiny", "right", "50", "48", "-2", "same"]
    judge.set_figures(50, 2)
    assert judge.run().returncode == 0, "the source is the same"
    done = judge.run("--again", "tiny")
    assert done.returncode == 1
    assert "worse" in next(line for line in done.stdout.splitlines() if " wrong " in line)


def test_the_judge_counts_missing_failed_and_new_figures_as_worse(tmp_path: Path):
    judge = TinyJudge(tmp_path)
    judge.set_figures(50, 1)
    done = judge.run()
    assert (done.returncode, done.stdout.count("not committed yet")) == (1, 2)
    judge.run("--write")
    judge.set_figures(50, 1, ("new", 3, "note"))
    done = judge.run("--again", "tiny")
    assert (done.returncode, done.stdout.count("not committed yet")) == (1, 1)
    (judge.work / "figures.json").unlink()
    done = judge.run("--again", "tiny")
    assert done.returncode == 1
    assert "failed: FileNotFoundError" in done.stdout


def test_tables_render_the_permitted_seeds_alone(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    renders = importlib.import_module("judge_tables.renders").RENDERS
    seeds = {words[words.index("--seed") + 1] for words in renders.values()}
    assert seeds == {1, 2, 3}
