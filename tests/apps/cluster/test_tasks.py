"""Test jobs of any kind on a cluster of two nodes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from small_jobs import Noting

from topoloc.apps.cluster.config import ClusterConfig
from topoloc.apps.cluster.connection import connect_to_cluster
from topoloc.apps.cluster.tasks import JobProgress, run_on_ray


def test_each_failure_is_that_of_its_job(cluster: Any, tmp_path: Path):
    does = ("nothing", "refuse", "die", "break", "nothing")
    jobs = [Noting(number, str(tmp_path / "log"), what) for number, what in enumerate(does)]
    heard: list[tuple[int, str | JobProgress]] = []
    outcomes = run_on_ray(
        jobs,
        cluster.address,
        ClusterConfig(max_retries=1),
        lambda number, state: heard.append((number, state)),
    )
    assert [outcome for outcome in outcomes if outcome.startswith("done")] == ["done 0", "done 4"]
    assert outcomes[1] == "failed 1: 1: no pictures"
    assert outcomes[2].startswith("failed 2: its worker ended: ")
    assert outcomes[3] == "failed 3: its worker ended: a bug"
    assert sorted(heard) == list(enumerate(outcomes))
    begun = (tmp_path / "log").read_text().split("\n")
    assert [begun.count(f"begin {number}") for number in range(5)] == [1, 1, 2, 1, 1]


def test_jobs_of_one_line_are_done_one_after_the_other(cluster: Any, tmp_path: Path):
    """A failed job does not stop its line, and lines run in parallel. One connection
    serves the block."""
    does = ("nothing", "die", "nothing", "nothing")
    lines = ("a", "a", "b", "a")
    logs = {line: tmp_path / line for line in lines}
    jobs = [
        Noting(number, str(logs[line]), what)
        for number, (line, what) in enumerate(zip(lines, does, strict=True))
    ]
    with connect_to_cluster(cluster.address) as ray:
        outcomes = run_on_ray(jobs, cluster.address, ClusterConfig(max_retries=0), lines=lines)
        assert ray.is_initialized()
    assert [outcome.split()[0] for outcome in outcomes] == ["done", "failed", "done", "done"]
    assert logs["a"].read_text().splitlines() == ["begin 0", "end 0", "begin 1", "begin 3", "end 3"]
    assert not ray.is_initialized()


def test_nothing_to_do(cluster: Any):
    assert run_on_ray([], cluster.address) == []
