"""Measure `topoloc map` over a long time: a recording is replayed back and forth, with other noise
and brightness each time, as one recording of many frames. Print speed, memory and the size of the
map by pieces.

    python benchmarks/growing_map.py RECORDING MAP --frames 36000
"""

from __future__ import annotations

import argparse
import resource
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from topoloc import GrowingMap, StereoFrame, StereoSequence, open_sequence


class Replayed:
    """A recording of `num_frames` frames, replayed back and forth with perturbed images."""

    def __init__(self, base: StereoSequence, num_frames: int) -> None:
        lap = [*range(len(base)), *range(len(base) - 2, 0, -1)]
        self.base, self.rows = base, [lap[k % len(lap)] for k in range(num_frames)]
        step_ns = int(np.median(np.diff(base.t_ns)))
        self.t_ns = [base.t_ns[0] + k * step_ns for k in range(num_frames)]
        self.name, self.names = base.name, [f"{k:06d}" for k in range(num_frames)]
        self.poses = [None] * num_frames

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: int) -> StereoFrame:
        frame = self.base[self.rows[index]]
        rng = np.random.default_rng(index)
        gain, shift = rng.uniform(0.9, 1.1), rng.uniform(-8, 8)
        noise = rng.normal(0.0, 3.0, frame.image.shape[:2])
        noise = noise[..., None] if frame.image.ndim == 3 else noise
        image = np.clip(frame.image * gain + shift + noise, 0, 255).astype(np.uint8)
        return replace(
            frame,
            name=self.names[index],
            t_ns=self.t_ns[index],
            image=image,
            world_from_cam=None,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording")
    parser.add_argument("map", type=Path)
    parser.add_argument("--frames", type=int, default=36_000)
    parser.add_argument("--piece", type=int, default=100)
    options = parser.parse_args()
    sequence = Replayed(open_sequence(options.recording), options.frames)
    growing, began, used = GrowingMap(options.map), time.monotonic(), time.process_time()
    print("frames  nodes  lost  MB map  MB memory  frames/s  frames/s of the processor")
    lost = done = 0
    while done < options.frames:
        end = min(done + options.piece, options.frames)
        growth = growing.add(sequence, end)
        lost, done = lost + growth.num_frames - growth.num_posed, end
        if done % (10 * options.piece) == 0 or done == options.frames:
            memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
            size = options.map.stat().st_size / 1e6
            speeds = done / (time.monotonic() - began), done / (time.process_time() - used)
            print(
                f"{done:6d} {growth.num_nodes:6d} {lost:5d} {size:7.1f} {memory:10.0f}"
                f" {speeds[0]:9.1f} {speeds[1]:9.1f}",
                flush=True,
            )
    growing.finish()


if __name__ == "__main__":
    main()
