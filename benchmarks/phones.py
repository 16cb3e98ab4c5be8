"""`topoloc serve` with many phones: each has a stream over a WebSocket, with an image a second.

    python benchmarks/phones.py MAP RECORDING [--phones 20] [--hz 1] [--seconds 60] [--settle 10]

Each phone has an address and a start in the recording of its own, and no calibration. Prints the
times from the moment an image is due to its answer, of the first seconds and of the rest, and how
many answers have a pose.
"""

from __future__ import annotations

import argparse
import json
import os
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from websockets.sync.client import connect

from service import Service, service
from topoloc import open_sequence
from topoloc.recordings.stored_images import encode_jpeg


@dataclass
class Answers:
    """Of all phones: when each image was due (seconds after the start), and how long it took."""

    due: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    num_localized: int = 0
    num_late: int = 0


def phone(
    of: Service, name: str, images: list[bytes], number: int, args: argparse.Namespace, to: Answers
) -> None:
    """Run one phone. An image that is due before the last answer is left out, as the page does."""
    address = f"ws://{of.host}:{of.port}/v1/maps/{name}/sessions?camera=unknown"
    with connect(address, source_address=(f"127.0.1.{number + 1}", 0)) as stream:
        start = time.perf_counter() + number / args.phones / args.hz
        for i in range(int(args.seconds * args.hz)):
            due = start + i / args.hz
            if time.perf_counter() > due + 1.0 / args.hz:
                to.num_late += 1
                continue
            time.sleep(max(0.0, due - time.perf_counter()))
            stream.send(images[(3 * number + i) % len(images)])
            answer = json.loads(stream.recv(timeout=60))
            to.seconds.append(time.perf_counter() - due)
            to.due.append(i / args.hz)
            to.num_localized += bool(answer.get("localized"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("map", type=Path)
    parser.add_argument("recording")
    parser.add_argument("--phones", type=int, default=20)
    parser.add_argument("--hz", type=float, default=1.0)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--settle", type=float, default=10.0)
    args = parser.parse_args()
    sequence = open_sequence(args.recording)
    images = [encode_jpeg(sequence[i].image, 85) for i in range(len(sequence))]
    answers = Answers()
    with service(args.map) as of:
        jobs = [
            threading.Thread(target=phone, args=(of, args.map.stem, images, n, args, answers))
            for n in range(args.phones)
        ]
        before = _processor_s(of.pid)
        for job in jobs:
            job.start()
        for job in jobs:
            job.join()
        processor_ms = 1e3 * (_processor_s(of.pid) - before) / max(1, len(answers.seconds))
    ms, settled = 1e3 * np.array(answers.seconds), np.array(answers.due) >= args.settle
    for label, chosen in ((f"first {args.settle:g} s", ms[~settled]), ("then", ms[settled])):
        p50, p99, most = np.percentile(chosen, [50, 99, 100]) if len(chosen) else (0, 0, 0)
        print(f"{label}: {len(chosen)} answers, p50 {p50:.0f}, p99 {p99:.0f}, most {most:.0f} ms")
    print(
        f"{args.phones} phones at {args.hz:g} Hz: {answers.num_localized} of {len(ms)} localized,"
        f" {answers.num_late} images left out because the last answer was late;"
        f" {processor_ms:.0f} ms of a processor for each answer"
    )


def _processor_s(pid: int) -> float:
    """Processor time of a process so far, which a busy machine does not change."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main()
