"""Test the preparation of a task on a worker. No cluster is needed."""

from __future__ import annotations

import os
import pickle
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest

from topoloc.apps.cluster.remote import (
    ProgressBoard,
    TaskPayload,
    TaskRequirements,
    _create_reporter,
    run_task,
)
from topoloc.apps.cluster.tiles import Outcome, TileJob, TileTask
from topoloc.errors import ClusterError, RecordingError


@dataclass(frozen=True)
class Witness:
    """Make no map, and raise an error that shows the folder and the environment of the call."""

    def make(self, progress: object):
        raise RecordingError(
            f"{os.getcwd()} {os.environ.get('SOURCE_DATE_EPOCH')}"
            f" {os.environ['OPENBLAS_NUM_THREADS']}"
        )

    def digest(self) -> str:
        return "ab" * 32


@pytest.fixture
def undone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Restore the folder, environment and threads of the process, which a task changes."""
    monkeypatch.chdir(".")
    for name in ("SOURCE_DATE_EPOCH", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.setenv(name, os.environ.get(name, "1"))
    monkeypatch.setattr("topoloc.set_num_threads", lambda number: None)


def _asked(work: TaskPayload) -> str:
    outcome: Outcome = pickle.loads(run_task(pickle.dumps(work), TaskRequirements(3), None, 0))
    assert outcome.state == "failed"
    assert outcome.reason is not None
    return outcome.reason


@pytest.mark.usefixtures("undone")
def test_paths_days_and_threads_are_the_drivers(tmp_path: Path):
    task = TileTask(TileJob("walk", "walk", "walk", Witness()), str(tmp_path / "campus"), False)
    assert _asked(TaskPayload(task, str(tmp_path), "86400")) == f"{tmp_path} 86400 3"
    assert _asked(TaskPayload(task, str(tmp_path / "not here"), None)) == "/ None 3"


def test_another_version_of_topoloc():
    with pytest.raises(ClusterError, match=r"has topoloc \S+, but the driver has 9\.9"):
        run_task(b"of another version", TaskRequirements(1, "9.9"), None, 0)


def test_the_board_is_written_now_and_then(monkeypatch: pytest.MonkeyPatch):
    board, now = ProgressBoard(), [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    written: list[tuple[str, int, int]] = []

    def write(number: int, line: tuple[str, int, int]) -> None:
        written.append(line)
        board.write(number, line)

    report = _create_reporter(SimpleNamespace(write=SimpleNamespace(remote=write)), 4)
    for done in range(1, 11):
        report("nodes", done, 10)
        now[0] += 0.07
    report("images", 1, 10)
    assert written == [("nodes", 1, 10), ("nodes", 6, 10), ("nodes", 10, 10), ("images", 1, 10)]
    assert board.read() == {4: ("images", 1, 10)}
