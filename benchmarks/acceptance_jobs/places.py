"""Build maps and query them: real recordings, out-of-map images, unknown cameras, times."""

from __future__ import annotations

import json
import math
import statistics
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from .answers import pose_difference
from .figures import Figure, errors_cm, rounded
from .workplace import ROOT, JobError, Workplace, last_line, run

FIT = "zed_lab/session1_from_session2.json"
QUERIES = {
    "zed": ("zed_lab/session2@0:99", ("--map-from-truth", FIT)),
    "kitchen": ("seven_scenes/kitchen@1::2", ()),
    "kitchen60": ("seven_scenes/kitchen@60-99/100", ()),
    "street1": ("kitti/sequences/street1@1::2", ()),
    "street2": ("kitti/sequences/street2@1::2", ()),
}


def demo(work: Workplace) -> Iterator[Figure]:
    """Run `topoloc demo`."""
    out = work.folder / "demo"
    evaluation = work.answer("demo", "--out", out)
    for row in evaluation["recordings"]:
        if row["num_queries"]:
            yield from errors_cm(row, row["name"])
    yield Figure(f"accepted of {evaluation['num_elsewhere']}", _accepted(evaluation), "at most")
    yield Figure("map, MB", rounded(evaluation["map"]["bytes"] / 1e6), "median")
    yield Figure("report is written", int((out / "report.html").stat().st_size > 10_000))


def evaluate(work: Workplace) -> Iterator[Figure]:
    """Build and evaluate the maps of real recordings."""
    for name in ["zed"] if work.quick else QUERIES:
        recording, options = QUERIES[name]
        words = [work.data(word) if word == FIT else word for word in options]
        evaluation = work.answer("evaluate", work.map(name), work.data(recording), *words)
        yield from errors_cm(evaluation, name)
        yield Figure(f"{name}: map, MB", rounded(evaluation["map"]["bytes"] / 1e6), "median")


def elsewhere(work: Workplace) -> Iterator[Figure]:
    """Query each map with images of the other places; none may get a pose."""
    zed = work.data("zed_lab/session2")
    other = {
        "zed": (work.data("seven_scenes/kitchen@1::4"), work.data("kitti/sequences/street1")),
        "kitchen": (zed, work.data("kitti/sequences/street2")),
        "street1": (zed, work.data("seven_scenes/kitchen@0::3")),
    }
    tower = sorted(Path(work.data("ie_tower")).rglob("*.jpg"))
    if work.quick:
        other = {"zed": (work.data("seven_scenes/kitchen@1::12"),)}
    for name, recordings in other.items():
        words = [word for path in recordings for word in ("--elsewhere", path)]
        evaluation = work.answer("evaluate", work.map(name), *words)
        asked = evaluation["num_elsewhere"]
        yield Figure(f"{name}: accepted of {asked}", evaluation["false_accepts"], "at most")
    chosen = tower[::26] if work.quick else tower[::2]
    lines = work.answer("localize", work.map("zed"), *chosen, timeout=600)
    accepted = sum(line["localized"] for line in lines)
    yield Figure(f"zed: accepted of {len(lines)} of ie_tower", accepted, "at most")


def unknown_focal_length(work: Workplace) -> Iterator[Figure]:
    """Localize single images without a calibration, and compare them with the truth."""
    chosen = {"lab": str(work.lab("day"))}
    if not work.quick:
        chosen["kitchen"] = work.data(QUERIES["kitchen"][0])
    for name, recording in chosen.items():
        known = work.answer("evaluate", work.map(name), recording)["answers"]
        truth = {_stem(answer["query"]): answer["true_world_from_cam"] for answer in known}
        options = ("--single", "--camera", "unknown")
        lines = work.answer("localize", work.map(name), recording, *options)
        yield from _against_truth(name, lines, truth)


def speed(work: Workplace) -> Iterator[Figure]:
    """Compare the time of a query with OpenCV's SIFT, image by image in one process."""
    script = Path(__file__).with_name("query_times.py")
    for name in ["zed"] if work.quick else ["zed", "kitchen", "street1"]:
        recording = work.data(QUERIES[name][0])
        ratio = json.loads(work.python(script, work.map(name), recording, 60))["ratio"]
        yield Figure(f"{name}: time of a query over SIFT's", rounded(ratio, 3), "time")


def equality(work: Workplace) -> Iterator[Figure]:
    """Compare the answers with those of the committed old version (benchmarks/equality.py)."""
    path = work.folder / "equality.json"
    words = ["--shared", work.shared, "--cache", work.cache, "--json", path]
    command = [sys.executable, ROOT / "benchmarks" / "equality.py", work.equal_to, *words]
    quick = ["--quick"] if work.quick else []
    _, out, err = run([*command, *quick], work.folder, timeout=900)
    if not path.exists():
        raise JobError(last_line(err) or last_line(out))
    for case, row in json.loads(path.read_text()).items():
        name = f"{case}: other answers than {work.equal_to} of {row['compared']}"
        yield Figure(name, row["different"], "at most")


def _accepted(evaluation: dict[str, Any]) -> int:
    """Return how many out-of-map images got a pose."""
    outside = [row for row in evaluation["recordings"] if not row["num_queries"]]
    return sum(row["false_accepts"] for row in outside)


def _stem(query: str) -> str:
    return Path(query).name.partition(".")[0]


def _against_truth(
    name: str, lines: list[dict[str, Any]], truth: dict[str, Any]
) -> Iterator[Figure]:
    found = [line for line in lines if line["localized"]]
    errors = [
        pose_difference(truth[_stem(line["query"])], line["world_from_cam"]) for line in found
    ]
    moved = statistics.median(error[0] for error in errors)
    turned = math.degrees(statistics.median(error[1] for error in errors))
    # p is the probability of an error below 0.25 m and 2 degrees. A larger sigma contradicts it.
    unsure = [
        line
        for line in found
        if line["probability"] > 0.95
        and (line["position_sigma_m"] > 0.25 or line["rotation_sigma_deg"] > 2.0)
    ]
    yield Figure(f"{name}: localized of {len(lines)}", len(found), "at least")
    yield Figure(f"{name}: median error, cm", rounded(100 * moved), "median")
    yield Figure(f"{name}: median error, deg", rounded(turned), "median")
    yield Figure(f"{name}: p above 0.95 against the sigmas", len(unsure), "at most")
