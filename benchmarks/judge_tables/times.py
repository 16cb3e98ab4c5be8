"""Tables of times, each relative to OpenCV's SIFT on the same images in the same run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from acceptance_jobs.figures import Figure, rounded

from .bench import Bench, figures_of
from .counts import KITCHEN

RULES = {"median": "time", "p95": "time", "over_sift": "time", "bytes_per_node": "median"}


def refusals(bench: Bench) -> Iterator[Figure]:
    """Answers and refusals, cold (each node is read for the first time) and warm."""
    zed = bench.map("zed", bench.data("zed_lab/session1"))
    corridor = bench.map("corridor1", bench.render("corridor1_map"))
    asked = {
        "zed": (zed, [bench.data("zed_lab/session2@0:60"), bench.data(f"{KITCHEN}@0::9")]),
        "corridor1": (
            corridor,
            [
                bench.render("corridor1_day"),
                bench.render("corridor2_day"),
                bench.render("corridor1_reverse"),
            ],
        ),
    }
    for place, (path, recordings) in asked.items():
        for number, recording in enumerate(recordings):
            found = bench.script("refusals", path, recording, recording, "--tree", bench.tree)
            for state, answers in zip(("cold", "warm"), found.values(), strict=True):
                name = f"{place}, {number + 1}: {_short(str(recording))}, {state}"
                yield from _rows_of(name, answers["here"])


def _short(recording: str) -> str:
    name = recording.rstrip("/").rpartition("/")[2]
    return name.rpartition("-")[0] or name


def _rows_of(name: str, answers: Sequence[Mapping[str, Any]]) -> Iterator[Figure]:
    """Return counts and times of the answers of one recording, by kind."""
    for kind in ("by nodes", "by virtual views", "refused"):
        rows = [row for row in answers if row["kind"] == kind]
        if not rows:
            continue
        rule = "note" if kind == "refused" else "at least"
        yield Figure(f"{name}, {kind}: images", len(rows), rule)
        sift = float(np.median([row["sift"] for row in answers]))
        for part, share in (("median", 50), ("p95", 95)):
            busy = float(np.percentile([row["cpu"] for row in rows], share)) / sift
            yield Figure(f"{name}, {kind}: {part} processor over SIFT", rounded(busy, 3), "time")
        ms = float(np.median([row["ms"] for row in rows]))
        yield Figure(f"{name}, {kind}: median ms", rounded(ms, 3), "note")


def service(bench: Bench) -> Iterator[Figure]:
    """A server with four clients, relative to the same localizer in a process of its own."""
    path = bench.map("zed", bench.data("zed_lab/session1"))
    words = (path, bench.data("zed_lab/session2"), "--speed", "--requests", 1000)
    row = bench.script("service", *words)
    relative = row["in_process_per_s"] / row["service_per_s"]
    yield Figure("time of an answer over that in process", rounded(relative, 3), "time")
    yield Figure("p99 over median", rounded(row["p99_ms"] / row["median_ms"], 3), "note")
    yield Figure("not answered", row["not_answered"], "at most")
    yield from figures_of("absolute", row)


def cost(bench: Bench) -> Iterator[Figure]:
    """Processor time of SLAM and of building, bytes a node."""
    recordings = {
        "zed": bench.data("zed_lab/session1"),
        "corridor1": f"{bench.render('corridor1_map')}@0:90",
        "street1": bench.data("kitti/sequences/street1"),
    }
    for name, recording in recordings.items():
        for command, row in bench.script("build_cost", recording).items():
            yield from figures_of(f"{name}, {command}", row, RULES)
