"""Code that runs on the cluster's machines: one task for each job, and a board of their progress.

This module imports no numeric library, because the number of threads must be set before.
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
    """A job, and the working folder and SOURCE_DATE_EPOCH of the driver."""

    job: Job[Any]
    folder: str
    epoch: str | None


@dataclass(frozen=True)
class TaskRequirements:
    """The number of threads and the driver's version of topoloc, known before unpickling."""

    num_threads: int
    version: str = field(default_factory=lambda: version("topoloc"))


def run_task(packed: bytes, terms: TaskRequirements, board: Any, number: int) -> bytes:
    """Run the job of a pickled `TaskPayload` and return its pickled outcome. `number`: the job's
    number on the board. Raises ClusterError: this machine has another version of topoloc;
    TopolocError: raised by the job."""
    if terms.version != (own := version("topoloc")):
        raise ClusterError(
            f"{platform.node()} has topoloc {own}, but the driver has {terms.version}"
        )
    os.environ |= dict.fromkeys(_THREAD_VARIABLES, str(terms.num_threads))
    work: TaskPayload = pickle.loads(packed)
    try:
        os.chdir(work.folder)
    except OSError:  # absolute paths still work, and relative ones must not match by chance
        os.chdir("/")
    os.environ.pop("SOURCE_DATE_EPOCH", None)
    if work.epoch is not None:
        os.environ["SOURCE_DATE_EPOCH"] = work.epoch
    from topoloc import set_num_threads

    set_num_threads(terms.num_threads)
    return pickle.dumps(work.job.run(_create_reporter(board, number)))


def _create_reporter(board: Any, number: int) -> Progress:
    """Return a function that writes progress to the board, if there is one."""
    if board is None:
        return lambda stage, done, total: None
    return throttle_progress(lambda *line: board.write.remote(number, line))


def throttle_progress(report: Progress) -> Progress:
    """Report the begin and the end of each stage, and progress a few times a second."""
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
    """Progress of each job, for display by the driver; an actor."""

    def __init__(self) -> None:
        self._lines: dict[int, tuple[str, int, int]] = {}

    def write(self, number: int, line: tuple[str, int, int]) -> None:
        """Set the progress of a job: stage, steps done, steps in all."""
        self._lines[number] = line

    def read(self) -> dict[int, tuple[str, int, int]]:
        """Return the progress of all jobs by number."""
        return self._lines


def create_progress_board(ray: Any) -> Any:
    """Start a `ProgressBoard` on the driver's machine. It restarts empty if it is lost."""
    node_id, strategies = ray.get_runtime_context().get_node_id(), ray.util.scheduling_strategies
    near = strategies.NodeAffinitySchedulingStrategy(node_id, soft=True)
    options = {"num_cpus": 0, "max_restarts": -1, "scheduling_strategy": near}
    return ray.remote(ProgressBoard).options(**options).remote()
