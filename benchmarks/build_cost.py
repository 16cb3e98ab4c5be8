"""Measure processor time of `slam` and `build`, relative to OpenCV's SIFT on the same images.

    python benchmarks/build_cost.py RECORDING [--json FILE]

SIFT runs in this process on every image of the recording, before the commands and after them; the
smaller time counts. The commands run in processes of their own. Also printed: nodes of the map,
bytes a node, and peak memory. A machine that is busy slows both, so a ratio moves by some percent.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2

from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.open import open_sequence

COMMANDS = {
    "slam": ("slam", "out.tum"),
    "build with poses": ("build", "truth.topo", "--trajectory", "truth"),
    "build without poses": ("build", "slam.topo", "--trajectory", "slam"),
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows: dict[str, dict[str, float]] = {}
    before = sift_seconds(arguments.recording)
    with tempfile.TemporaryDirectory() as temporary:
        for name, (command, out, *options) in COMMANDS.items():
            path = Path(temporary) / out
            words = [command, arguments.recording, str(path), *options]
            rows[name] = processor_seconds(words)
            if path.suffix == ".topo":
                with TopoMetricMap.load(path) as topomap:
                    rows[name]["nodes"] = len(topomap.nodes)
                rows[name]["bytes_per_node"] = path.stat().st_size / rows[name]["nodes"]
    sift = min(before, sift_seconds(arguments.recording))
    for name, row in rows.items():
        row["over_sift"] = row["processor_s"] / sift
        print(name, ", ".join(f"{key} {value:.2f}" for key, value in row.items()), sep=": ")
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1))


def sift_seconds(recording: str) -> float:
    """Return the processor time of SIFT on the left images of a recording."""
    sift, seconds = cv2.SIFT_create(), 0.0  # pyright: ignore[reportAttributeAccessIssue]
    sequence = open_sequence(recording)
    for index in range(len(sequence)):
        image = sequence[index].image
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
        start = time.process_time()
        sift.detectAndCompute(grey, None)
        seconds += time.process_time() - start
    return seconds


def processor_seconds(words: list[str]) -> dict[str, float]:
    """Run a command of topoloc. Return its processor time and peak memory.

    Raises:
        SystemExit: The command failed.
    """
    start = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "topoloc", *words], stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        raise SystemExit(f"{' '.join(words[:2])}: exit status {process.returncode}")
    return {
        "processor_s": used.ru_utime + used.ru_stime,
        "wall_s": time.perf_counter() - start,
        "memory_mb": used.ru_maxrss / 1024,
    }


if __name__ == "__main__":
    main()
