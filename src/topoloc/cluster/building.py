"""An atlas built on a Ray cluster: one task a recording, each of which adds its own tile.

The driver hands out what is to be done and hears what became of it; maps never pass through it. Whoever dies is begun again: a worker by
Ray, the driver by its user. What lies in the atlas by then is found there and not made twice (`tiles.py`).
"""

from __future__ import annotations

import os
import pickle
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from topoloc.cluster.config import ClusterConfig
from topoloc.cluster.connection import connected
from topoloc.cluster.remote import Terms, Work, progress_board, run_task
from topoloc.cluster.tiles import Outcome, TileJob, manifest_of
from topoloc.errors import TopolocError

_LOOK_S = 0.5
Show = Callable[[int, "Outcome | Running"], None]
"""Called with a recording's number and what is known of it now."""


@dataclass(frozen=True)
class Running:
    """A recording that is being mapped: the stage it is in, and how much of it is done."""

    stage: str
    done: int
    total: int


@dataclass(frozen=True)
class AtlasBuild:
    """Recordings, and the atlas that they become tiles of; `replaces` as of `build_tile`."""

    jobs: Sequence[TileJob]
    atlas: str
    replaces: bool = False
    config: ClusterConfig = field(default_factory=ClusterConfig)


def build_on_ray(build: AtlasBuild, address: str, show: Show | None = None, is_live: bool = False) -> list[Outcome]:
    """All recordings mapped, and their tiles in the atlas; what became of each, in their order.

    Args:
        address: of the cluster, as `connected` takes it.
        show: is told of each recording that is finished, and with `is_live` several times a second of those that are being mapped.

    Raises:
        MissingExtraError, ClusterError: as of `connected`.
        AtlasError: what lies where the atlas is to be is none, or its store does not answer.
    """
    manifest_of(build.atlas)  # known before a cluster is asked
    show = show or (lambda number, state: None)
    with connected(address) as ray:
        _warn_of_few_processors(ray, build.config.cpus_per_recording)
        board = progress_board(ray) if is_live else None
        numbers = {_submitted(ray, build, number, board): number for number in range(len(build.jobs))}
        outcomes: dict[int, Outcome] = {}
        while numbers:
            done, _ = ray.wait(list(numbers), num_returns=len(numbers), timeout=_LOOK_S) if is_live else ray.wait(list(numbers))
            for ref in done:
                number = numbers.pop(ref)
                outcomes[number] = _outcome(ray, ref, build.jobs[number])
                show(number, outcomes[number])
            if board is not None:
                _look(ray, board, outcomes, show)
        return [outcomes[number] for number in range(len(build.jobs))]


def _warn_of_few_processors(ray: Any, wanted: int) -> None:
    """A cluster may grow as it is asked; one that does not would let the recordings wait for ever."""
    most = max((node["Resources"].get("CPU", 0.0) for node in ray.nodes() if node["Alive"]), default=0.0)
    if most < wanted:
        print(f"warning: no machine of the cluster has {wanted} processors for a recording now, {most:g} at most", file=sys.stderr)


def _submitted(ray: Any, build: AtlasBuild, number: int, board: Any) -> Any:
    job, config = build.jobs[number], build.config
    atlas = build.atlas if "://" in build.atlas else os.path.abspath(build.atlas)
    work = Work(job, atlas, build.replaces, os.getcwd(), os.environ.get("SOURCE_DATE_EPOCH"))
    task = ray.remote(run_task).options(
        num_cpus=config.cpus_per_recording,
        memory=config.memory_mb_per_recording * 1_000_000 or None,
        max_retries=config.max_retries,
        name=f"topoloc build {job.tile_id}",
    )
    return task.remote(pickle.dumps(work), Terms(config.cpus_per_recording), board, number)


def _outcome(ray: Any, ref: Any, job: TileJob) -> Outcome:
    """What the task says; where it cannot say anything any more, why not."""
    try:
        return pickle.loads(ray.get(ref))
    except ray.exceptions.RayError as error:
        cause = getattr(error, "cause", None)
        text = " ".join(str(error if cause is None else cause).split())[:300]
        return Outcome(job.recording, job.tile_id, "failed", text if isinstance(cause, TopolocError) else f"its worker ended: {text}")


def _look(ray: Any, board: Any, outcomes: dict[int, Outcome], show: Show) -> None:
    """Where the board, which is only for the eye, does not answer, the work goes on."""
    with suppress(ray.exceptions.RayError):
        for number, (stage, done, total) in ray.get(board.read.remote(), timeout=5.0).items():
            if number not in outcomes:
                show(number, Running(stage, done, total))
