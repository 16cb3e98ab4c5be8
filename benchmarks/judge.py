"""Print the tables by which a change of answers is judged, beside the committed ones.

    python benchmarks/judge.py [--only TABLE ...] [--list] [--write] [--tree PATH]
        [--work build/judge] [--shared ../shared]

Each table is a benchmark of this folder with fewer images. A line is printed for each figure:
table, figure, committed value, value now, difference, verdict. A line at the end of a table has its
seconds. The exit status is 1 if a figure is worse, missing or not committed, or if a table failed.
Fewer right or more wrong answers are worse, but for the slack of a table (2 in `inputs`,
`calibration` and poses inside the ellipsoid). Medians may rise by 5 %, times relative to OpenCV's
SIFT by 20 %. Times of a busy machine mean nothing: run those tables at rest, with --only.

A finished table is kept below --work by a digest of the package's source and of its benchmark, and
is not run again; delete it, or name it with --again. Maps are kept by the source, rendered images
(seeds 1 to 3) by their settings. --tree judges another checkout's source. --write stores the values
in benchmarks/judged/.
"""

from __future__ import annotations

import argparse
import hashlib
import inspect
import json
import os
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path
from typing import Any

from acceptance_jobs.figures import Committed, Figure, Row, compare
from acceptance_jobs.workplace import ROOT, SkippedError
from judge_tables.bench import Bench, digest_of
from judge_tables.registry import TABLES, Table

NUM_AT_A_TIME = 2
JUDGED = Path(__file__).with_name("judged")
Measured = tuple[list[Figure], str, float]
"""The figures of a table, how it ended (empty, skipped or failed), and the seconds it took."""


def measure(name: str, table: Table, bench: Bench) -> Measured:
    """Return a table that was finished before, or run it."""
    path = bench.work / "tables" / f"{name}-{digest(table, bench)}.json"
    if path.exists():
        kept = json.loads(path.read_text(encoding="utf-8"))
        return [Figure(**figure) for figure in kept["figures"]], "", kept["seconds"]
    start, figures = time.perf_counter(), list[Figure]()
    try:
        figures.extend(table.run(bench))
    except SkippedError as missing:
        return figures, f"skipped: {missing}", time.perf_counter() - start
    except Exception as error:  # whatever a table raises is its line
        lines = str(error).strip().splitlines() or [""]
        return figures, f"failed: {type(error).__name__}: {lines[-1]}", time.perf_counter() - start
    seconds = time.perf_counter() - start
    path.parent.mkdir(parents=True, exist_ok=True)
    kept = {"seconds": seconds, "figures": [asdict(figure) for figure in figures]}
    path.write_text(json.dumps(kept), encoding="utf-8")
    return figures, "", seconds


def digest(table: Table, bench: Bench) -> str:
    """Return a digest of the source tree, of the table and of its benchmarks."""
    digest = hashlib.sha256(bench.digest.encode())
    digest.update(inspect.getsource(table.run).encode())
    for script in table.scripts:
        digest.update((ROOT / "benchmarks" / script).read_bytes())
    return digest.hexdigest()[:12]


def rows_of(name: str, figures: list[Figure], ending: str, committed: Committed) -> list[Row]:
    """Return the lines of a table; one that failed has a line more."""
    rows = compare(name, figures, committed.of_job(name))
    rows = [row for row in rows if not (ending and row.verdict == "missing")]
    return [*rows, Row(name, "", None, None, ending)] if ending else rows


def text_of(row: Row) -> str:
    """Return a line with the difference."""
    difference = ""
    if isinstance(row.now, int | float) and isinstance(row.committed, int | float):
        difference = f"{row.now - row.committed:+.4g}"
    values = f"{_short(row.committed):>10} {_short(row.now):>10} {difference:>10}"
    return f"{row.job:16} {row.figure:64} {values}  {row.verdict}"


def _short(value: Any) -> str:
    return "-" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)


def judge(chosen: list[str], bench: Bench, judged: Path, write: bool) -> Iterator[Row]:
    """Run the tables of counts two at a time, then those of times one by one, and print them."""
    parts = [[name for name in chosen if TABLES[name].alone is alone] for alone in (False, True)]
    for part, num in zip(parts, (NUM_AT_A_TIME, 1), strict=True):
        with ThreadPoolExecutor(num) as pool:
            running = {pool.submit(measure, name, TABLES[name], bench): name for name in part}
            for done in as_completed(running):
                name = running[done]
                figures, ending, seconds = done.result()
                committed = Committed(judged / f"{name}.json", "all")
                rows = rows_of(name, figures, ending, committed)
                print("".join(f"{text_of(row)}\n" for row in rows), end="")
                print(f"{name:16} {seconds:.0f} s", flush=True)
                if write and not ending:
                    judged.mkdir(exist_ok=True)
                    committed.store(name, figures, whole=True)
                    committed.write()
                yield from rows


def main() -> int:
    arguments = parsed()
    if arguments.list:
        for name, table in TABLES.items():
            about = table.about or (table.run.__doc__ or "").strip()
            print(f"{name:16} {' '.join(about.split())}")
        return 0
    tree, work = arguments.tree.resolve(), arguments.work.resolve()
    work.mkdir(parents=True, exist_ok=True)
    bench = Bench(work, arguments.shared.resolve(), tree, digest_of(tree))
    for name in arguments.again or []:
        for path in (work / "tables").glob(f"{name}-{digest(TABLES[name], bench)}.json"):
            path.unlink()
    chosen = arguments.only or arguments.again or list(TABLES)
    rows = list(judge(chosen, bench, arguments.judged, arguments.write))
    worse = sum(row.is_worse for row in rows)
    skipped = sum(row.verdict.startswith("skipped") for row in rows)
    print(f"{len(rows)} lines, {worse} worse, {skipped} skipped")
    return int(worse > 0 and not arguments.write)


def parsed() -> argparse.Namespace:
    """Return the arguments."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", action="append", choices=list(TABLES), metavar="TABLE")
    parser.add_argument("--again", action="append", choices=list(TABLES), metavar="TABLE")
    parser.add_argument("--list", action="store_true", help="print the names of the tables")
    parser.add_argument("--write", action="store_true", help="store the measured values")
    parser.add_argument("--tree", type=Path, default=ROOT, help="checkout that is judged")
    parser.add_argument("--work", type=Path, default=ROOT / "build" / "judge")
    parser.add_argument("--judged", type=Path, default=JUDGED, help="folder of committed tables")
    shared = Path(os.environ.get("TOPOLOC_SHARED", ROOT.parent / "shared"))
    parser.add_argument("--shared", type=Path, default=shared)
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
