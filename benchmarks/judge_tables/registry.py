"""List the tables in the order in which they run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from acceptance_jobs import motion, places
from acceptance_jobs.figures import Figure
from acceptance_jobs.workplace import Workplace

from . import counts, times
from .bench import Bench

Job = Callable[[Workplace], Iterator[Figure]]


@dataclass(frozen=True)
class Table:
    """Hold a table, the benchmarks behind it, and whether it measures times and so runs alone."""

    run: Callable[[Bench], Iterator[Figure]]
    scripts: tuple[str, ...] = ()
    alone: bool = False
    about: str = ""


def of_job(name: str, job: Job, script: str, alone: bool = False) -> Table:
    """Return the table of a job of `make acceptance`."""
    about = (job.__doc__ or "").strip()
    return Table(lambda bench: job(bench.workplace(name)), (script,), alone, about)


TABLES = {
    "far": Table(counts.far, ("exactness.py",)),
    "exactness": Table(counts.exactness, ("exactness.py",)),
    "evaluate": of_job("evaluate", places.evaluate, "acceptance_jobs/places.py"),
    "elsewhere": of_job("elsewhere", places.elsewhere, "acceptance_jobs/places.py"),
    "slam": of_job("slam", motion.slam, "acceptance_jobs/motion.py"),
    "streams": Table(counts.streams, ("streams.py",)),
    "calibration": Table(counts.calibration, ("calibration_verdict.py",)),
    "wrong-recordings": Table(
        counts.wrong_recordings,
        ("wrong_recordings.py", "variants/right.py", "variants/wrong.py", "variants/walks.py"),
    ),
    "inputs": Table(counts.inputs, ("inputs.py",)),
    "recall": Table(counts.recall, ("exactness.py",)),
    "aside": Table(counts.aside, ("exactness.py",)),
    "floors": Table(counts.floors, ("floors.py",)),
    "reverse": Table(counts.reverse, ("other_way.py",)),
    "aliased": Table(counts.aliased, ("aliased_place.py",)),
    "speed": of_job("speed", places.speed, "acceptance_jobs/query_times.py", alone=True),
    "refusals": Table(times.refusals, ("refusals.py",), alone=True),
    "service": Table(times.service, ("service.py",), alone=True),
    "cost": Table(times.cost, ("build_cost.py",), alone=True),
}
