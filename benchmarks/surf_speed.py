"""Times of SURF, with OpenCV's SIFT and ORB beside it in the same run.

    python benchmarks/surf_speed.py [--shared ../shared] [--repeats 100]

Prints milliseconds for key points with descriptors, image in memory, after warm-up: median, minimum
and the range between the quartiles; and how many times as long as SURF on two threads the others
take. All run interleaved, so that a busy machine slows them alike. OpenCV's are asked for as many
features as SURF finds.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import tyro

from topoloc.features.surf import extract_surf

SIZES = {"kitchen": (640, 480), "zed": (672, 376), "kitti": (1241, 376)}


@dataclass(frozen=True)
class Args:
    shared: Path = Path(os.environ.get("TOPOLOC_SHARED", Path(__file__).parents[2] / "shared"))
    repeats: int = 100


def time_interleaved_ms(
    functions: dict[str, Callable[[], object]], repeats: int
) -> dict[str, np.ndarray]:
    times = {name: np.zeros(repeats) for name in functions}
    for repeat in range(-3, repeats):
        for name, function in functions.items():
            start = time.perf_counter()
            function()
            if repeat >= 0:
                times[name][repeat] = (time.perf_counter() - start) * 1e3
    return times


def main(args: Args) -> None:
    image = np.zeros((64, 64), np.uint8)
    start = time.perf_counter()
    extract_surf(image)
    print(
        "first call (compilation, or reading the compiled code):"
        f" {time.perf_counter() - start:.1f} s"
    )
    cv2.setNumThreads(2)
    for name, size in SIZES.items():
        image = np.load(args.shared / "reference" / "surf" / f"{name}.npz")["image"]
        if image.shape != size[::-1]:
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        count = len(extract_surf(image))
        sift, orb = cv2.SIFT_create(count), cv2.ORB_create(count)
        times = time_interleaved_ms(
            {
                "SURF 2 threads": lambda image=image: extract_surf(image, num_threads=2),
                "SURF 1 thread": lambda image=image: extract_surf(image, num_threads=1),
                "OpenCV SIFT": lambda image=image, sift=sift: sift.detectAndCompute(image, None),
                "OpenCV ORB": lambda image=image, orb=orb: orb.detectAndCompute(image, None),
            },
            args.repeats,
        )
        print(
            f"\n{name} {size[0]}x{size[1]}, {count} key points        median     min     IQR   x"
            " SURF"
        )
        for label, values in times.items():
            low, median, high = np.percentile(values, [25, 50, 75])
            ratio = median / np.median(times["SURF 2 threads"])
            print(f"  {label:<40}{median:8.2f}{values.min():8.2f}{high - low:8.2f}{ratio:8.2f}")


if __name__ == "__main__":
    main(tyro.cli(Args))
