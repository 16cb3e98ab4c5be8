"""Run the program as users do, on real recordings, and compare the figures with committed values.

    python benchmarks/acceptance.py [--quick] [--only JOB ...] [--write] [--shared ../shared]

Each job runs commands in a temporary folder and yields figures. A line is printed for each figure:
job, figure, committed value, value now, verdict. Counts are exact, medians may rise by 5 %, times
are ratios to OpenCV's SIFT on the same images in the same run and may rise by 20 %. The budgets of
the jobs `structure` and `costs` may rise by 3 %. The exit status is 1 if a figure is worse, missing
or not committed, or if a job failed.

`--write` stores the measured values in benchmarks/acceptance.json. A changed value needs a commit
of its own; its message gives the old value, the new value and the reason.
"""

from __future__ import annotations

import argparse
import os
import resource
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from pathlib import Path

from acceptance_jobs.figures import Committed, Figure, Row, compare
from acceptance_jobs.registry import JOBS
from acceptance_jobs.workplace import ROOT, SkippedError, Workplace

NUM_AT_A_TIME = 2
VALUES = Path(__file__).with_name("acceptance.json")


def measure(job: str, workplace: Workplace) -> tuple[list[Figure], str]:
    """Return the figures of a job, and how it ended: empty, `skipped: ...` or `failed: ...`."""
    figures: list[Figure] = []
    try:
        for figure in JOBS[job].run(workplace.job_folder()):
            figures.append(figure)
    except SkippedError as missing:
        return figures, f"skipped: {missing}"
    except Exception as error:  # a job of its own: whatever it raises is its line
        lines = str(error).strip().splitlines() or [""]
        return figures, f"failed: {type(error).__name__}: {lines[-1]}"
    return figures, ""


def rows_of(job: str, figures: list[Figure], ending: str, committed: Committed) -> list[Row]:
    """Return the lines of a job; figures that a failed or skipped job lacks are one line."""
    known = committed.of_job(job)
    if ending:
        measured = {figure.name for figure in figures}
        known = {name: value for name, value in known.items() if name in measured}
    rows = compare(job, figures, known)
    return [*rows, Row(job, "", None, None, ending)] if ending else rows


@contextmanager
def workplace_for(arguments: argparse.Namespace, committed: Committed) -> Iterator[Workplace]:
    """Make the temporary folder of a run."""
    with tempfile.TemporaryDirectory(prefix="topoloc-acceptance-") as temporary:
        folder = Path(temporary)
        (folder / "maps").mkdir()
        shared = arguments.shared.resolve()
        equal_to = committed.setting("equal_to", "aea690a")
        yield Workplace(
            folder, folder / "maps", shared, arguments.quick, equal_to, arguments.cache.resolve()
        )


def run_jobs(
    jobs: list[str], workplace: Workplace, committed: Committed, write: bool
) -> Iterator[Row]:
    """Run the jobs that measure times one by one, then the others two at a time."""
    waiting = sorted(jobs, key=lambda job: not JOBS[job].alone)
    num_alone = sum(JOBS[job].alone for job in jobs)
    with ThreadPoolExecutor(1) as one, ThreadPoolExecutor(NUM_AT_A_TIME) as several:
        for pool, part in ((one, waiting[:num_alone]), (several, waiting[num_alone:])):
            running = {pool.submit(timed, job, workplace): job for job in part}
            for done in as_completed(running):
                job = running[done]
                figures, ending, seconds = done.result()
                rows = rows_of(job, figures, ending, committed)
                print("".join(f"{row.text()}\n" for row in rows), end="", flush=True)
                print(f"{job:12} {seconds:.0f} s", file=sys.stderr, flush=True)
                if write and not ending.startswith("failed"):
                    committed.store(job, figures, whole=not ending)
                    committed.write()
                yield from rows


def timed(job: str, workplace: Workplace) -> tuple[list[Figure], str, float]:
    """Return the result of `measure`, and the seconds that it took."""
    start = time.perf_counter()
    return *measure(job, workplace), time.perf_counter() - start


def main() -> int:
    arguments = parsed()
    start, committed = time.perf_counter(), Committed(VALUES, "quick" if arguments.quick else "all")
    chosen = [name for name, job in JOBS.items() if job.quick or not arguments.quick]
    with workplace_for(arguments, committed) as workplace:
        rows = list(run_jobs(arguments.only or chosen, workplace, committed, arguments.write))
    worse = sum(row.is_worse for row in rows)
    skipped = sum(row.verdict.startswith("skipped") for row in rows)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(
        f"{len(rows)} lines, {worse} worse, {skipped} skipped; {time.perf_counter() - start:.0f} s,"
        f" {used.ru_utime + used.ru_stime:.0f} s of the processor"
    )
    return int(worse > 0 and not arguments.write)


def parsed() -> argparse.Namespace:
    """Return the arguments."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="the jobs of make acceptance-quick")
    parser.add_argument("--only", action="append", choices=list(JOBS), metavar="JOB")
    parser.add_argument("--write", action="store_true", help="store the measured values")
    shared = Path(os.environ.get("TOPOLOC_SHARED", ROOT.parent / "shared"))
    parser.add_argument("--shared", type=Path, default=shared)
    parser.add_argument("--cache", type=Path, default=ROOT / "build" / "acceptance")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
