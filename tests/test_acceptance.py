"""Test parts of `make acceptance`: old files, the figures of the demo, and the rules
of comparison."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "benchmarks" / "acceptance.py"


@pytest.fixture
def jobs(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Import the package of the jobs, which lies beside the script."""
    monkeypatch.syspath_prepend(str(SCRIPT.parent))
    return lambda name: importlib.import_module(f"acceptance_jobs.{name}")


def run(*words: object) -> subprocess.CompletedProcess[str]:
    """Run the script as a user does."""
    command = [sys.executable, str(SCRIPT), *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.parametrize("job", ["old-files", "demo"])
def test_a_job_has_no_worse_figure(job: str):
    """These jobs need no recordings beside those of the repository."""
    done = run("--quick", "--only", job)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow  # tests/test_recordings.py maps and queries the same recordings
def test_another_session_in_the_zed_lab(shared: Path):
    done = run("--quick", "--only", "evaluate", "--shared", shared)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "zed: localized of 99" in done.stdout


def test_missing_recordings_are_skipped_with_a_reason(tmp_path: Path):
    done = run("--quick", "--only", "evaluate", "--shared", tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "skipped: no zed_lab/session1" in done.stdout


def test_verdicts(jobs: Any):
    verdict = jobs("figures").verdict
    assert [verdict("at least", 32, now) for now in (31, 32, 33)] == ["worse", "same", "better"]
    assert [verdict("at most", 1, now) for now in (2, 1, 0)] == ["worse", "same", "better"]
    assert [verdict("median", 1.0, now) for now in (1.06, 1.04, 0.9)] == ["worse", "same", "better"]
    assert [verdict("time", 1.0, now) for now in (1.3, 1.1, 0.7)] == ["worse", "same", "better"]
    assert [verdict("budget", 100, now) for now in (104, 103, 96)] == ["worse", "same", "better"]
    assert [verdict("equal", "a", now) for now in ("a", "b")] == ["same", "worse"]


def test_a_figure_that_is_missing_or_not_committed_is_worse(jobs: Any):
    figures = jobs("figures")
    committed = {"a": {"value": 1, "rule": "equal"}, "b": {"value": 1, "rule": "equal"}}
    measured = [figures.Figure("a", 1), figures.Figure("c", 1)]
    rows = figures.compare("job", measured, committed)
    assert [(row.figure, row.is_worse) for row in rows] == [("a", False), ("c", True), ("b", True)]


def test_a_job_that_raises_is_a_failed_line(jobs: Any, tmp_path: Path):
    workplace = jobs("workplace")
    place = workplace.Workplace(tmp_path, tmp_path, tmp_path, True, "aea690a", tmp_path)
    with pytest.raises(workplace.JobError, match=r"exit status 1: error: .*nowhere\.topo"):
        place.topoloc("info", tmp_path / "nowhere.topo")
    with pytest.raises(workplace.JobError, match="no end after 1 s"):
        place.python("-c", "import time; time.sleep(30)", timeout=1)
    with pytest.raises(workplace.SkippedError, match="no zed_lab"):
        place.data("zed_lab/session1@0:10")


def test_answers_that_differ_are_found(jobs: Any):
    answers = jobs("answers")
    expected = ROOT / "tests" / "fixtures" / "aea690a" / "expected.json"
    old = json.loads(expected.read_text(encoding="utf-8"))["answers"]["schema_3.topo"]
    assert answers.compare_answers(old, old).different == 0
    moved, other = json.loads(json.dumps(old)), json.loads(json.dumps(old))
    moved[0]["world_from_cam"]["translation"][1] += 2e-6
    for answers_now, factor in ((old, 1.0), (other, 1.0 + 3e-6)):
        answers_now[2]["covariance"] = (factor * np.diag([1.0, 4.0, 9.0, 1.0, 1.0, 1.0])).tolist()
    other[1]["node"] += 1
    del other[4]
    found = answers.compare_answers(old, moved)
    assert (found.different, round(found.position, 9)) == (1, 2e-6)
    found = answers.compare_answers(old, other)
    assert (found.different, round(found.covariance, 9)) == (3, 3e-6)
    turned = {"translation": [0.0, 0.0, 0.0], "quat_wxyz": [1.0, 1e-6, 0.0, 0.0]}
    straight = {"translation": [0.0, 0.0, 0.0], "quat_wxyz": [-1.0, 0.0, 0.0, 0.0]}
    assert answers.pose_difference(straight, turned) == pytest.approx((0.0, 2e-6))


def import_equality() -> Any:
    """Return benchmarks/equality.py as a module."""
    sys.path.insert(0, str(SCRIPT.parent))
    try:
        return importlib.import_module("equality")
    finally:
        sys.path.remove(str(SCRIPT.parent))


def test_a_part_of_the_equality_is_as_before(jobs: Any, shared: Path):
    """The cases name their commands; the files that they query are there."""
    equality = import_equality()
    cases = equality.cases(shared / "data", quick=False)
    names = ["demo", "zed", "kitchen", "street", "uncalibrated", "out of map", "atlas"]
    assert [case.name for case in cases] == names
    with_last_step = equality.cases(shared / "data", quick=False, has_last_step=True)
    assert len(with_last_step) == len({case.name for case in with_last_step}) == 19
    images = [word for case in with_last_step for word in case.query if isinstance(word, Path)]
    assert len(images) >= 30 + 60 + 24 + 12
    assert all(path.exists() for path in images)


def test_answers_of_an_old_commit_are_kept_by_case(jobs: Any, tmp_path: Path):
    equality = import_equality()
    first, second = equality.cases(tmp_path / "missing", quick=False, has_last_step=True)[:2]
    kept = equality.Kept(tmp_path, "0123456789abcdef", [first, second], tmp_path)
    kept.write({second.name: [{"query": "a", "localized": False}]})
    assert kept.read() == {second.name: [{"query": "a", "localized": False}]}
    alone = equality.Kept(tmp_path, "0123456789abcdef", [second], tmp_path)
    assert alone.read() == {}, "its maps are made by other commands"
