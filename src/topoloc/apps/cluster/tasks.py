"""Work of any kind on a Ray cluster, as its driver sees it: jobs are handed out, one task each, and
what became of them is heard.

What a job needs and makes travels by files that all machines see; through here go settings,
progress and small outcomes. Whoever dies is begun again: a worker by Ray, the driver by its user,
so that a job should find what it has done already.
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
from functools import partial
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
    """A piece of work. It is pickled, and so is its outcome, which is small."""

    @property
    def name(self) -> str:
        """What Ray's own pages call it."""
        ...

    def run(self, progress: Progress) -> Outcome_co:
        """Do it, in a worker whose folder and SOURCE_DATE_EPOCH are the driver's. It may be begun
        again from the start."""
        ...

    def failure_outcome(self, reason: str) -> Outcome_co:
        """The outcome, where `run` raised a TopolocError or its worker could not say anything any
        more."""
        ...


@dataclass(frozen=True)
class JobProgress:
    """A job that is being done: the stage it is in, and how much of it is done."""

    stage: str
    done: int
    total: int


OnJobState = Callable[[int, T | JobProgress], None]
"""Called with a job's number and what is known of it now: its outcome, or how far it is."""


def run_on_ray(
    jobs: Sequence[Job[T]],
    address: str,
    config: ClusterConfig | None = None,
    show: OnJobState[T] | None = None,
    is_live: bool = False,
    lines: Sequence[str] | None = None,
) -> list[T]:
    """What became of each job, in their order.

    Args:
        address: of the cluster, as `connect_to_cluster` takes it; inside of a block of that with
            the same address, it is the same connection.
        show: is told of each job that is finished, and with `is_live` several times a second of
            those that are being done.
        lines: a name for each job; those of one name are done one after the other, in their order.
            None: all side by side.

    Raises:
        MissingExtraError, ClusterError: as of `connect_to_cluster`.
    """
    config, show = config or ClusterConfig(), show or (lambda number, state: None)
    with (
        redirect_stdout(io.StringIO()),
        connect_to_cluster(address) as ray,
    ):  # Ray prints there of workers that died, which are begun again
        _warn_few_cpus(ray, config.cpus_per_recording)
        board = create_progress_board(ray) if is_live else None
        queues = _group_queues(len(jobs), lines)
        running = {_submit_job(ray, jobs, queue[0], config, board): queue for queue in queues}
        outcomes: dict[int, T] = {}
        while running:
            done, _ = (
                ray.wait(list(running), num_returns=len(running), timeout=_POLL_INTERVAL_S)
                if is_live
                else ray.wait(list(running))
            )
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
    """As `run_on_ray`, in this process, one after the other."""

    show = show or (lambda number, state: None)
    outcomes = list[T]()
    for number, job in enumerate(jobs):
        tell = partial(_report_running, show, number) if is_live else _ignore_progress
        try:
            outcome = job.run(throttle_progress(tell))
        except TopolocError as error:
            outcome = job.failure_outcome(" ".join(str(error).split()))
        outcomes.append(outcome)
        show(number, outcome)
    return outcomes


def _report_running(show: OnJobState[Any], number: int, stage: str, done: int, total: int) -> None:
    show(number, JobProgress(stage, done, total))


def _ignore_progress(stage: str, done: int, total: int) -> None:
    pass


def _group_queues(num_jobs: int, lines: Sequence[str] | None) -> list[deque[int]]:
    """The numbers of the jobs, in queues of which each is done one after the other."""
    if lines is None:
        return [deque([number]) for number in range(num_jobs)]
    queues = dict[str, deque[int]]()
    for number, line in zip(range(num_jobs), lines, strict=True):
        queues.setdefault(line, deque()).append(number)
    return list(queues.values())


def _warn_few_cpus(ray: Any, wanted: int) -> None:
    """A cluster may grow as it is asked; one that does not would let the jobs wait for ever."""
    most = max(
        (node["Resources"].get("CPU", 0.0) for node in ray.nodes() if node["Alive"]), default=0.0
    )
    if most < wanted:
        print(
            f"warning: no machine of the cluster has {wanted} processors for a task now, {most:g}"
            " at most",
            file=sys.stderr,
        )


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
    """What the task says; where it cannot say anything any more, why not."""
    try:
        return pickle.loads(ray.get(ref))
    except ray.exceptions.RayError as error:
        cause = getattr(error, "cause", None)
        text = " ".join(str(error if cause is None else cause).split())[:300]
        return job.failure_outcome(
            text if isinstance(cause, TopolocError) else f"its worker ended: {text}"
        )


def _poll_progress(ray: Any, board: Any, outcomes: dict[int, T], show: OnJobState[T]) -> None:
    """Where the board, which is only for the eye, does not answer, the work goes on."""
    with suppress(ray.exceptions.RayError):
        for number, (stage, done, total) in ray.get(board.read.remote(), timeout=5.0).items():
            if number not in outcomes:
                show(number, JobProgress(stage, done, total))
