"""Print the ratio of the time of a query to that of OpenCV's SIFT on the same images.

    python benchmarks/acceptance_jobs/query_times.py MAP SEQ NUMBER

Both take turns, image by image, so that a change of the machine's speed meets both. `ratio` is of
the medians, `ratio_95` of the 95th percentile of queries to the median of SIFT. Each node is read
for the first time. The peak memory of the process is printed, too, in MB.
"""

from __future__ import annotations

import json
import resource
import statistics
import sys
import time
from collections.abc import Callable

import topoloc

WARM_UP = 5


def main(map_path: str, recording: str, number: int) -> None:
    sequence = topoloc.open_sequence(recording)
    frames = [sequence[i] for i in range(min(number, len(sequence)))]
    localizer = topoloc.Localizer(topoloc.TopoMetricMap.load(map_path))
    for frame in frames[:WARM_UP]:
        localizer.localize(frame.image, frame.camera)
    del localizer
    localizer = topoloc.Localizer(topoloc.TopoMetricMap.load(map_path))  # reads its nodes anew
    import cv2

    cv2.setNumThreads(2)
    detector = cv2.SIFT_create()  # pyright: ignore[reportAttributeAccessIssue]
    ours, theirs = [], []
    for frame in frames:
        grey = frame.image
        if grey.ndim == 3:
            grey = cv2.cvtColor(grey, cv2.COLOR_RGB2GRAY)
        ours.append(_seconds(localizer.localize, frame.image, frame.camera))
        theirs.append(_seconds(detector.detectAndCompute, grey, None))
    sift = statistics.median(theirs)
    ratios = {"ratio": statistics.median(ours) / sift, "ratio_95": _percentile(ours, 0.95) / sift}
    memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps(ratios | {"memory_mb": memory_mb, "ms": 1e3 * statistics.median(ours)}))


def _percentile(values: list[float], share: float) -> float:
    return sorted(values)[round(share * (len(values) - 1))]


def _seconds(work: Callable[..., object], *arguments: object) -> float:
    start = time.perf_counter()
    work(*arguments)
    return time.perf_counter() - start


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
