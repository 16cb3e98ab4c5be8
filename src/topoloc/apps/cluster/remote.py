"""What runs on the cluster's machines: a task a job, and a board on which the tasks write how far
they are.

This module loads nothing heavy by itself, so that the threads of the numeric libraries are said
before any of them is loaded.
"""

from __future__ import annotations

import os
import pickle
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from topoloc import ClusterError

if TYPE_CHECKING:
    from topoloc.apps.cluster.tasks import Job

_REPORT_INTERVAL_S = 0.3
Progress = Callable[[str, int, int], None]
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class TaskPayload:
    """A job. `folder` is the driver's, where relative paths begin; `epoch` its
    SOURCE_DATE_EPOCH."""

    job: Job[Any]
    folder: str
    epoch: str | None


@dataclass(frozen=True)
class TaskRequirements:
    """What is said before the work is unpacked: threads it may use, and the driver's version of
    topoloc."""

    num_threads: int
    version: str = field(default_factory=lambda: version("topoloc"))


def run_task(packed: bytes, terms: TaskRequirements, board: Any, number: int) -> bytes:
    """A pickled `TaskPayload` is done; returns the job's outcome, pickled. `number` is that of the
    job on the board.

    Raises:
        ClusterError: this machine has another version of topoloc.
        TopolocError: as of the job.
    """
    if terms.version != version("topoloc"):
        raise ClusterError(
            f"{platform.node()} has topoloc {version('topoloc')}, and {terms.version} asks it"
        )
    os.environ |= dict.fromkeys(_THREAD_VARIABLES, str(terms.num_threads))
    work: TaskPayload = pickle.loads(packed)
    try:
        os.chdir(work.folder)
    except (
        OSError
    ):  # then whole paths are found all the same, and others are not looked for elsewhere
        os.chdir("/")
    os.environ.pop("SOURCE_DATE_EPOCH", None)
    if work.epoch is not None:
        os.environ["SOURCE_DATE_EPOCH"] = work.epoch
    from topoloc import set_num_threads

    set_num_threads(terms.num_threads)
    return pickle.dumps(work.job.run(_create_reporter(board, number)))


def _create_reporter(board: Any, number: int) -> Progress:
    """Writes on the board now and then; whether anybody reads it does not matter here."""
    if board is None:
        return lambda stage, done, total: None
    return throttle_progress(lambda *line: board.write.remote(number, line))


def throttle_progress(report: Progress) -> Progress:
    """Tells of each stage when it begins and when it ends, and in between a few times a second."""
    last = [("", 0.0)]

    def report_throttled(stage: str, done: int, total: int) -> None:
        before, when = last[0]
        now = time.monotonic()
        if stage == before and now - when < _REPORT_INTERVAL_S and done < total:
            return
        last[0] = (stage, now)
        report(stage, done, total)

    return report_throttled


class ProgressBoard:
    """How far each job is, for the eyes of the driver; an actor."""

    def __init__(self) -> None:
        self._lines: dict[int, tuple[str, int, int]] = {}

    def write(self, number: int, line: tuple[str, int, int]) -> None:
        """Of a job: stage, steps done, steps in all."""
        self._lines[number] = line

    def read(self) -> dict[int, tuple[str, int, int]]:
        """All lines, by the numbers of the jobs."""
        return self._lines


def create_progress_board(ray: Any) -> Any:
    """A `ProgressBoard` beside the driver; it begins empty again where it is lost."""
    near = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(
        ray.get_runtime_context().get_node_id(), soft=True
    )
    return (
        ray.remote(ProgressBoard)
        .options(num_cpus=0, max_restarts=-1, scheduling_strategy=near)
        .remote()
    )
