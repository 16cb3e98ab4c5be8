"""How long opening a recording and reading a frame of it take: minima over several runs, in
milliseconds.

python benchmarks/read_recordings.py PATH [PATH ...]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

from topoloc.recordings.image_io import image_size
from topoloc.recordings.open import open_sequence


def least_ms(action: Callable[[], object], repetitions: int) -> float:
    times = []
    for _ in range(repetitions):
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return 1e3 * min(times)


def main(paths: list[str]) -> None:
    print(f"{'recording':40s} {'frames':>6s} {'open':>8s} {'frame':>8s} {'check':>8s}")
    for path in paths:
        sequence = open_sequence(path)
        open_ms = least_ms(lambda path=path: open_sequence(path), 5)
        frame_ms = least_ms(lambda sequence=sequence: sequence[0], 20)
        first = sequence.root / sequence.names[0]
        check_ms = least_ms(lambda first=first: image_size(first), 20)
        print(f"{path[-40:]:40s} {len(sequence):6d} {open_ms:8.2f} {frame_ms:8.2f} {check_ms:8.3f}")


if __name__ == "__main__":
    main(sys.argv[1:])
