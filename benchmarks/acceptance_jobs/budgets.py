"""Measure budgets: files and statements that a query enters, and the cost of commands."""

from __future__ import annotations

import json
import resource
from collections.abc import Iterator
from pathlib import Path

from .figures import Figure, rounded
from .workplace import ROOT, Workplace

NUM_RUNS = 2
MAPPED = "zed_lab/session1@0:60"
STRUCTURE = """
import json, sys
from pathlib import Path
import house
root, cache = Path(sys.argv[1]), Path(sys.argv[2])
print(json.dumps(dict(house.queries(house.House(root, cache)))))"""
SIFT = """
import sys, time, cv2, topoloc
sequence = topoloc.open_sequence(sys.argv[1])
frames = [sequence[i] for i in range(len(sequence))]
images = [image for frame in frames for image in (frame.image, frame.right)]
grey = [cv2.cvtColor(i, cv2.COLOR_RGB2GRAY) if i.ndim == 3 else i for i in images]
sift, start = cv2.SIFT_create(), time.process_time()
for image in grey:
    sift.detectAndCompute(image, None)
print(time.process_time() - start)"""


def structure(work: Workplace) -> Iterator[Figure]:
    """Count files, statements and changes of file of a clear and of a refused query."""
    program = f"import sys; sys.path.insert(0, {str(ROOT / 'tools')!r}){STRUCTURE}"
    counts = json.loads(work.python("-c", program, ROOT, work.folder))
    yield from (Figure(name, counts[name], "budget") for name in sorted(counts))


def costs(work: Workplace) -> Iterator[Figure]:
    """Measure queries whose nodes are read for the first time, `build`, `slam`, bytes a node.

    Times are ratios to those of OpenCV's SIFT: of one image for a query, of both images of all
    frames for the processor time of `build` and `slam`. Each is the least of a few runs.
    """
    script, session = Path(__file__).with_name("query_times.py"), work.data("zed_lab/session2@0:99")
    runs = [json.loads(work.python(script, work.map("zed"), session, 99)) for _ in range(NUM_RUNS)]
    for name, key in (("median", "ratio"), ("95 %", "ratio_95")):
        least = min(run[key] for run in runs)
        yield Figure(f"cold walk, {name} over SIFT's", rounded(least, 3), "budget")
    outputs, recording = {"build": "built.topo", "slam": "walk.tum"}, work.data(MAPPED)
    seconds: dict[str, list[float]] = {name: [] for name in ("sift", *outputs)}
    for _ in range(NUM_RUNS):
        seconds["sift"].append(float(work.python("-c", SIFT, recording)))
        for name, file in outputs.items():
            seconds[name].append(_processor_seconds(work, name, recording, work.folder / file))
    for name in outputs:
        ratio = min(seconds[name]) / min(seconds["sift"])
        yield Figure(f"{name}: processor time over SIFT's", rounded(ratio, 3), "budget")
    for name in ("zed", "kitchen", "street1"):
        num_bytes = work.map(name).stat().st_size
        num_nodes = work.answer("info", work.map(name))["num_nodes"]
        yield Figure(f"{name}: kB a node", rounded(num_bytes / num_nodes / 1e3), "budget")


def _processor_seconds(work: Workplace, command: str, recording: str, out: Path) -> float:
    """Return the processor time of a command; no other job may run."""
    out.unlink(missing_ok=True)
    start = resource.getrusage(resource.RUSAGE_CHILDREN)
    work.topoloc(command, recording, out)
    end = resource.getrusage(resource.RUSAGE_CHILDREN)
    return end.ru_utime + end.ru_stime - start.ru_utime - start.ru_stime
