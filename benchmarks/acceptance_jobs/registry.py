"""List the jobs in the order in which they run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from . import atlases, budgets, edits, long_jobs, motion, old_files, pages, places, serving, sizes
from .figures import Figure
from .workplace import Workplace


@dataclass(frozen=True)
class Job:
    """Hold a job, whether `--quick` runs it, and whether it measures times and so runs alone."""

    run: Callable[[Workplace], Iterator[Figure]]
    quick: bool = False
    alone: bool = False


JOBS = {
    "demo": Job(places.demo, quick=True),
    "evaluate": Job(places.evaluate, quick=True),
    "elsewhere": Job(places.elsewhere, quick=True),
    "focal": Job(places.unknown_focal_length, quick=True),
    "speed": Job(places.speed, quick=True, alone=True),
    "stream": Job(motion.stream, quick=True),
    "slam": Job(motion.slam),
    "edits": Job(edits.edits, quick=True),
    "old-files": Job(old_files.old_files, quick=True),
    "atlas": Job(atlases.atlas),
    "export": Job(atlases.export),
    "serve": Job(serving.serve),
    "pages": Job(pages.pages, quick=True),
    "size": Job(sizes.size, quick=True, alone=True),
    "structure": Job(budgets.structure),
    "costs": Job(budgets.costs, alone=True),
    "equality": Job(places.equality, quick=True),
    "train": Job(long_jobs.train),
    "paper": Job(long_jobs.paper),
    "fuzz": Job(long_jobs.fuzz),
    "test-slow": Job(long_jobs.test_slow),
}
