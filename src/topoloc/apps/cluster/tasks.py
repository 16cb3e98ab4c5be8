"""Run jobs on a Ray cluster, one task each, and collect their outcomes.

Jobs read and write files that all machines share. Only settings, progress and small outcomes pass
through the driver. Ray restarts a lost worker and the user restarts the driver, so a job should
recognize work that it has done before.
"""

from __future__ import annotations

import io
import os
import pickle
import sys
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar, runtime_checkable

from topoloc import TopolocError
from topoloc.apps.cluster.config import ClusterConfig
from topoloc.apps.cluster.connection import connect_to_cluster
from topoloc.apps.cluster.remote import (
    Progress,
    TaskPayload,
    TaskRequirements,
    create_progress_board,
    run_task,
    throttle_progress,
)

_POLL_INTERVAL_S = 0.5
T = TypeVar("T")
Outcome_co = TypeVar("Outcome_co", covariant=True)


@runtime_checkable
class Job(Protocol[Outcome_co]):
    """A piece of work. It and its small outcome are pickled."""

    @property
    def name(self) -> str:
        """Name on Ray's dashboard."""
        ...

    def run(self, progress: Progress) -> Outcome_co:
        """Run the job, with the folder and SOURCE_DATE_EPOCH of the driver. It may run again."""
        ...

    def failure_outcome(self, reason: str) -> Outcome_co:
        """Return the outcome after a TopolocError of `run` or the loss of the worker."""
        ...


@dataclass(frozen=True)
class JobProgress:
    """Progress of a running job: its stage, steps done and steps in all."""

    stage: str
    done: int
    total: int


OnJobState = Callable[[int, T | JobProgress], None]
"""Called with a job's number and its outcome or progress."""


def run_on_ray(
    jobs: Sequence[Job[T]],
    address: str,
    config: ClusterConfig | None = None,
    show: OnJobState[T] | None = None,
    is_live: bool = False,
    lines: Sequence[str] | None = None,
) -> list[T]:
    """Run the jobs and return their outcomes in order. Raises MissingExtraError, ClusterError: see
    `connect_to_cluster`.

    Args:
        address: cluster, as for `connect_to_cluster`.
        show: called for each finished job, and with `is_live` several times a second for each
            running job.
        lines: a name for each job. Jobs of the same name run one after the other, in order.
            Default: all jobs may run in parallel.
    """
    config, show = config or ClusterConfig(), show or (lambda number, state: None)
    # Ray prints messages about restarted workers
    with redirect_stdout(io.StringIO()), connect_to_cluster(address) as ray:
        _warn_few_cpus(ray, config.cpus_per_recording)
        board = create_progress_board(ray) if is_live else None
        queues = _group_queues(len(jobs), lines)
        running = {_submit_job(ray, jobs, queue[0], config, board): queue for queue in queues}
        outcomes: dict[int, T] = {}
        while running:
            limits = {"num_returns": len(running), "timeout": _POLL_INTERVAL_S} if is_live else {}
            done, _ = ray.wait(list(running), **limits)
            for ref in done:
                queue = running.pop(ref)
                number = queue.popleft()
                if queue:
                    running[_submit_job(ray, jobs, queue[0], config, board)] = queue
                outcomes[number] = _get_outcome(ray, ref, jobs[number])
                show(number, outcomes[number])
            if board is not None:
                _poll_progress(ray, board, outcomes, show)
        return [outcomes[number] for number in range(len(jobs))]


def run_locally(
    jobs: Sequence[Job[T]], show: OnJobState[T] | None = None, is_live: bool = False
) -> list[T]:
    """Run the jobs in this process, one after the other. See `run_on_ray`."""
    show, outcomes = show or (lambda number, state: None), list[T]()
    for number, job in enumerate(jobs):

        def report(stage: str, done: int, total: int, number: int = number) -> None:
            if is_live:
                show(number, JobProgress(stage, done, total))

        try:
            outcome = job.run(throttle_progress(report))
        except TopolocError as error:
            outcome = job.failure_outcome(" ".join(str(error).split()))
        outcomes.append(outcome)
        show(number, outcome)
    return outcomes


def _group_queues(num_jobs: int, lines: Sequence[str] | None) -> list[deque[int]]:
    """Return queues of job numbers. Jobs of one queue run one after the other."""
    if lines is None:
        return [deque([number]) for number in range(num_jobs)]
    queues = dict[str, deque[int]]()
    for number, line in zip(range(num_jobs), lines, strict=True):
        queues.setdefault(line, deque()).append(number)
    return list(queues.values())


def _warn_few_cpus(ray: Any, wanted: int) -> None:
    """Warn if no machine is large enough. Unless the cluster grows, the jobs would wait forever."""
    counts = [node["Resources"].get("CPU", 0.0) for node in ray.nodes() if node["Alive"]]
    if (most := max(counts, default=0.0)) < wanted:
        need = f"a task needs {wanted} processors"
        machines = f"no machine of the cluster has more than {most:g}"
        print(f"warning: {need}, but {machines}", file=sys.stderr)


def _submit_job(
    ray: Any, jobs: Sequence[Job[Any]], number: int, config: ClusterConfig, board: Any
) -> Any:
    work = TaskPayload(jobs[number], os.getcwd(), os.environ.get("SOURCE_DATE_EPOCH"))
    task = ray.remote(run_task).options(
        num_cpus=config.cpus_per_recording,
        memory=config.memory_mb_per_recording * 1_000_000 or None,
        max_retries=config.max_retries,
        name=f"topoloc {jobs[number].name}",
    )
    return task.remote(
        pickle.dumps(work), TaskRequirements(config.cpus_per_recording), board, number
    )


def _get_outcome(ray: Any, ref: Any, job: Job[T]) -> T:
    """Return the outcome of a task, or a failure if it was lost."""
    try:
        return pickle.loads(ray.get(ref))
    except ray.exceptions.RayError as error:
        cause = getattr(error, "cause", None)
        text = " ".join(str(error if cause is None else cause).split())[:300]
        return job.failure_outcome(
            text if isinstance(cause, TopolocError) else f"its worker ended: {text}"
        )


def _poll_progress(ray: Any, board: Any, outcomes: dict[int, T], show: OnJobState[T]) -> None:
    """Show the progress. If the board does not answer, the work continues."""
    with suppress(ray.exceptions.RayError):
        for number, (stage, done, total) in ray.get(board.read.remote(), timeout=5.0).items():
            if number not in outcomes:
                show(number, JobProgress(stage, done, total))
