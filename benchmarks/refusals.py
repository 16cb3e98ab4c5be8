"""Milliseconds of answers and refusals, where they go, and the numbers by which a query stops.

    python benchmarks/refusals.py MAP SEQ [SEQ ...] [--tree TREE] [--beside TREE] [--fast]
                                  [--light L] [--json FILE]
    python benchmarks/refusals.py MAP SEQ [SEQ ...] --fit [--light L]

Each image of each recording is asked of the map, by a process of its own. With --beside, a process
with the source code of another folder takes turns with it, image by image, so that a machine's
changing speed meets both. The table has, for each recording and tree: images localized by nodes and
by virtual views, and refused; their median and 95th percentile of milliseconds and the median
processor time; the mean milliseconds of each source of proposals; and which source and feature type
gave the reported pose. `sift` is the processor time of OpenCV's SIFT on the same images. A
recording that is named twice is warm the second time: its nodes were read. Last comes what differs
between the trees. --light 0.1 asks the images darkened to a tenth, with noise of one grey level.

--fit prints what a right pose shows at each step, where the numbers of `NodeStop` and `WallStop`
come from: the inliers of the retrieved nodes of images that nodes localize, by feature type; and
the agreement of strong and of all matches at the best place, in the nearest parts and in the whole
views, where it is right (within 0.5 m and 10 degrees of the truth). The others are wrong places.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.result import Localization
from topoloc.localization.search import Search, Trace
from topoloc.recordings.frame import StereoFrame
from topoloc.recordings.open import open_sequence

SOURCES = (
    "from_other_features",
    "voted_places",
    "node_viewpoints",
    "similar_places",
    "repetitions",
)
Answer = dict[str, Any]
spent: dict[str, float] = defaultdict(float)


def timed(name: str, propose: Callable[..., Any]) -> Callable[..., Iterator[Any]]:
    """Add the milliseconds of a source of proposals to `spent`, without those of verification."""

    def run(search: Search, *arguments: object) -> Iterator[Any]:
        proposals = iter(propose(search, *arguments))
        while True:
            start = time.perf_counter()
            proposal = next(proposals, None)
            spent[f"{name}:{search.map.kind.name}"] += 1e3 * (time.perf_counter() - start)
            if proposal is None:
                return
            yield proposal

    return run


def work(fast: bool, light: float) -> None:
    """Answer the questions of standard input, one line each: the map, a recording, an index."""
    # older trees import the sources elsewhere
    modules = [one for name, one in sys.modules.items() if name.startswith("topoloc.localization")]
    for name in (*SOURCES, "virtual_views"):
        for module in modules:
            if source := getattr(module, f"propose_{name}", None):
                setattr(module, f"propose_{name}", timed(name, source))
    localizers, sequences = dict[str, Localizer](), dict[str, Any]()
    config = LocalizerConfig(exactness="fast" if fast else "best")
    for line in sys.stdin:
        path, recording, index = json.loads(line)
        if path not in localizers:
            localizers[path] = Localizer(path, config)
        if recording not in sequences:
            sequences[recording] = open_sequence(recording)
        sequence = sequences[recording]
        is_over = index >= len(sequence)
        answer = None if is_over else ask(localizers[path], in_light(sequence[index], light))
        print(json.dumps(answer), flush=True)


def in_light(frame: StereoFrame, light: float) -> StereoFrame:
    """Return the frame with its image darkened to this share."""
    if light == 1.0:
        return frame
    noise = np.random.default_rng(0).normal(0.0, 1.0, frame.image.shape)
    image = np.clip(np.round(frame.image * light + noise), 0, 255).astype(np.uint8)
    return replace(frame, image=image)


def ask(localizer: Localizer, frame: StereoFrame) -> Answer:
    """Return the compared values of one answer."""
    spent.clear()
    trace, start, busy = Trace(), time.perf_counter(), time.process_time()
    result = localizer.localize(frame.image, frame.camera, trace=trace)
    answer: Answer = {
        "ms": 1e3 * (time.perf_counter() - start),
        "cpu": 1e3 * (time.process_time() - busy),
        "sift": sift_ms(frame.image),
        "stages": result.times_ms,
        "sources": dict(spent),
    }
    if not isinstance(result, Localization):
        return answer | {"kind": "refused", "by": result.reason}
    tried = [one for one in trace.tried if one.hypothesis is not None]
    by = [f"{k.source}:{k.features}" for k in tried if k.hypothesis.evidence == result.evidence]  # pyright: ignore[reportOptionalMemberAccess]
    return answer | {
        "kind": "by nodes" if result.is_of_nodes else "by virtual views",
        "by": by[0] if by else "pixels or other types",
        "probability": result.probability,
        "position": result.world_from_cam.translation.tolist(),
        "error_m": error_of(result.world_from_cam, frame)[0],
    }


def sift_ms(image: np.ndarray) -> float:
    """Return the processor time of OpenCV's SIFT on an image, by which machines differ."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
    start = time.process_time()
    cv2.SIFT_create().detectAndCompute(grey, None)  # pyright: ignore[reportAttributeAccessIssue]
    return 1e3 * (time.process_time() - start)


def error_of(world_from_cam: Any, frame: StereoFrame) -> tuple[float, float]:
    """Return the error of a pose in metres and degrees, infinite without truth."""
    if frame.world_from_cam is None:
        return float("inf"), float("inf")
    error = world_from_cam.inverse() @ frame.world_from_cam
    return float(np.linalg.norm(error.translation)), float(np.rad2deg(error.angle()))


class Worker:
    """Hold a process that answers with the source code of a folder."""

    def __init__(self, tree: Path, asked: argparse.Namespace) -> None:
        path = os.pathsep.join(str(tree / part) for part in ("src", "worlds/src"))
        options = ["--light", str(asked.light), *(["--fast"] if asked.fast else [])]
        command = [sys.executable, __file__, "--work", *options]
        self._process = subprocess.Popen(
            command,
            env=os.environ | {"PYTHONPATH": path},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def ask(self, question: list[Any]) -> Answer | None:
        """Return the answer, None after the end of the recording."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(question) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())


def measure(asked: argparse.Namespace) -> dict[str, dict[str, list[Answer]]]:
    """Return the answers of each tree to each recording."""
    trees = {"here": Worker(asked.tree, asked)}
    if asked.beside:
        trees = {"beside": Worker(asked.beside, asked)} | trees
    for worker in trees.values():  # the first query loads kernels and nodes
        worker.ask([asked.map, asked.recordings[0], 0])
    found: dict[str, dict[str, list[Answer]]] = {}
    for recording in asked.recordings:
        name = f"{recording}, again" if recording in found else recording
        rows = found[name] = {name: [] for name in trees}
        index = 0
        while True:
            order = list(trees.items())[:: -1 if index % 2 else 1]
            answers = {name: one.ask([asked.map, recording, index]) for name, one in order}
            if any(answer is None for answer in answers.values()):
                break
            for name, answer in answers.items():
                rows[name].append(answer or {})
            index += 1
    return found


def report(found: dict[str, dict[str, list[Answer]]]) -> None:
    for recording, trees in found.items():
        print(f"\n{recording}")
        for name, answers in trees.items():
            for kind in ("by nodes", "by virtual views", "refused"):
                rows = [one for one in answers if one["kind"] == kind]
                if rows:
                    print(f"  {name:6} {kind:16} {figures(rows)}")
        if len(trees) == 2:
            print(f"  {differences(*trees.values())}")


def figures(rows: list[Answer]) -> str:
    ms, cpu = ([row[name] for row in rows] for name in ("ms", "cpu"))
    sift = np.median([row["sift"] for row in rows])
    parts = [f"{len(rows):4} median {np.median(ms):4.0f} p95 {np.percentile(ms, 95):4.0f} ms,"]
    parts.append(f"processor {np.median(cpu):4.0f} ms, sift {sift:.0f};")
    for name in ("stages", "sources"):
        total: Counter[str] = Counter()
        for row in rows:
            total.update(row[name])
        means = {k: v / len(rows) for k, v in total.items() if k != "total"}
        parts += [f"{k} {v:.0f}" for k, v in means.items() if v >= 0.5]
    return " ".join(parts) + f"; {dict(Counter(row['by'] for row in rows))}"


def differences(before: list[Answer], now: list[Answer]) -> str:
    """Describe the differences between the answers of two trees."""
    lost = [k for k, (a, b) in enumerate(zip(before, now, strict=True)) if _is(a) > _is(b)]
    won = [k for k, (a, b) in enumerate(zip(before, now, strict=True)) if _is(a) < _is(b)]
    both = [(a, b) for a, b in zip(before, now, strict=True) if _is(a) and _is(b)]
    moved = max(
        (float(np.linalg.norm(np.subtract(a["position"], b["position"]))) for a, b in both),
        default=0.0,
    )
    surer = max((abs(a["probability"] - b["probability"]) for a, b in both), default=0.0)
    return f"lost {lost}, won {won}; largest differences {moved:.1e} m, p {surer:.1e}"


def _is(answer: Answer) -> bool:
    return answer["kind"] != "refused"


def fit(path: str, recordings: list[str], light: float) -> None:
    """Print the figures of right poses at each step."""
    # older trees, which --beside runs, have these elsewhere
    from topoloc.localization.propose import propose_first
    from topoloc.localization.query import Deadline, QueryImage, StageClock

    localizer, inliers = Localizer(path), defaultdict[str, list[int]](list)
    right, wrong = defaultdict[str, list[int]](list), defaultdict[str, list[int]](list)
    for recording in recordings:
        for plain in open_sequence(recording):
            frame = in_light(plain, light)
            assert frame.camera is not None
            query_image = QueryImage(frame.image, frame.camera)
            answer = ask(localizer, frame)
            searches = localizer.context.searches(query_image, StageClock(), Deadline())
            for search in searches:
                propose_first(search, None)
                if answer["kind"] == "by nodes":
                    inliers[search.map.kind.name].append(search.num_retrieved)
            for search in searches:
                if search.map.walls is not None and answer["kind"] != "by nodes":
                    for name, is_right, number in agreements(search, frame):
                        (right if is_right else wrong)[name].append(number)
    for kind, numbers in inliers.items():
        print(f"{kind}: inliers of images that nodes localize: {quantiles(numbers)}")
    for name in wrong | right:
        print(f"{name}: right {quantiles(right[name])}; wrong {quantiles(wrong[name])}")


def agreements(search: Search, frame: StereoFrame) -> Iterator[tuple[str, bool, int]]:
    """Generate the agreement at the best place of each step, and whether the image's right place is
    among those of the whole views."""
    from topoloc.localization.walls.propose_virtual_views import Comparison
    from topoloc.localization.walls.virtual_view_matching import VirtualViewSearch

    index, stop = search.map.walls, search.weights.walls.stop
    assert index is not None
    whole = VirtualViewSearch.around(search, index)
    compared = [Comparison.at_place(whole, place) for place in whole.places]
    proposed = [(one, found) for one in compared if (found := one.match_all()) is not None]
    errors = [error_of(found.cam_from_world.inverse(), frame) for _, found in proposed]
    near_right = [
        pair for pair, (m, deg) in zip(proposed, errors, strict=True) if m < 0.5 and deg < 10.0
    ]
    is_right, chosen = bool(near_right), near_right or proposed
    parts = VirtualViewSearch.around(search, index, stop.near_tangent or float("inf"))
    strong = [Comparison.at_place(parts, place).num_strong for place in parts.places]
    yield "nearest parts, strong", is_right, max(strong, default=0)
    strong = [one.num_strong for one, _ in chosen]
    yield "whole views, strong", is_right, max(strong, default=0)
    yield "whole views, all", is_right, max((found.num_agreeing for _, found in chosen), default=0)


def quantiles(numbers: list[int]) -> str:
    if not numbers:
        return "none"
    least, low, median, most = np.percentile(numbers, [0, 0.5, 50, 100])
    logs = np.log(np.maximum(numbers, 1))
    fitted = np.exp(logs.mean() - 2.33 * logs.std())  # the 1 % quantile of a normal distribution
    return (
        f"{len(numbers)}: least {least:.0f}, 0.5 % {low:.0f}, median {median:.0f}, most {most:.0f},"
        f" 1 % of a log-normal distribution {fitted:.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map", nargs="?")
    parser.add_argument("recordings", nargs="*")
    parser.add_argument("--tree", type=Path, default=Path(__file__).parents[1])
    parser.add_argument("--beside", type=Path, help="folder with other source code")
    parser.add_argument("--fast", action="store_true", help="without the last step")
    parser.add_argument("--light", type=float, default=1.0)
    parser.add_argument("--fit", action="store_true")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.work:
        work(asked.fast, asked.light)
    elif asked.fit:
        fit(asked.map, asked.recordings, asked.light)
    else:
        found = measure(asked)
        report(found)
        if asked.json:
            asked.json.write_text(json.dumps(found))


if __name__ == "__main__":
    main()
