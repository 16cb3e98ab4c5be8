"""Leave out depth that sticks at the end of a sensor's range: beyond it some drivers write the
range, not "unknown"."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float32

from topoloc.recordings.frame import StereoSequence, sequence_subset


def leave_out_stuck_depth(
    sequence: StereoSequence, warn: Callable[[str], object] | None = None
) -> StereoSequence:
    """Return a recording without depth at the end of the sensor's range. `warn` is called with that
    range. Raises as the recording."""
    largest = find_stuck_depth(sequence)
    if largest is None:
        return sequence
    if warn is not None:
        warn(
            f"{sequence.name}: depth of {largest:.4g} m is left out: the same largest value fills"
            " part of every image, so it is the end of the sensor's range, not a distance"
        )
    return sequence_subset(sequence, range(len(sequence)), max_depth=largest)


def find_stuck_depth(sequence: StereoSequence) -> float | None:
    """Return the largest depth (metres) of a recording if it is the end of the sensor's range.

    It is the same number in most of some images and fills a part of each, far more than any other
    value near it: distances to walls differ from pixel to pixel and from image to image.
    """
    num_frames, min_frames, min_share, max_share, min_ratio = 8, 3, 0.02, 0.95, 4.0
    if not len(sequence) or sequence[0].depth is None:
        return None
    rows = np.unique(np.linspace(0, len(sequence) - 1, num_frames).astype(int)).tolist()
    ends = [
        end
        for row in rows
        if (one := sequence[row].depth) is not None
        for end in _end_of(one.depth)
    ]
    if len(ends) < min_frames:
        return None
    largest = max(end for end, _, _ in ends)
    at_end = [(share, ratio) for end, share, ratio in ends if end == largest]
    if 4 * len(at_end) < 3 * len(ends):
        return None
    share, ratio = np.median(at_end, axis=0)
    return largest if min_share < share < max_share and ratio > min_ratio else None


def _end_of(depth: Float32[np.ndarray, "h w"]) -> list[tuple[float, float, float]]:
    """Return the largest depth, its share of the known pixels, and how many times as frequent it is
    as any other value from half of it on. Empty if no depth is known."""
    some = depth[::2, ::2]
    values, counts = np.unique(some[np.isfinite(some)], return_counts=True)
    if len(values) == 0:
        return []
    others = counts[:-1][values[:-1] > 0.5 * values[-1]]
    return [(float(values[-1]), counts[-1] / counts.sum(), counts[-1] / others.max(initial=1))]
