"""Tell where the clock of a bag was set back, and put the parts one after the other.

The header times of a simulator that is reset, or of a bag that is played in a loop, begin anew.
Sorted by them, the pictures of two places would alternate. The order of writing separates the
parts.
"""

from __future__ import annotations

import bisect
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from jaxtyping import Int64

Place = tuple[int, ...]
# Pictures that overtake each other on their way to the recorder differ by less.
_MIN_SETBACK_NS = 300_000_000
# Changes from one part to the other in the order of time. Parts in the wrong order have one.
_MIN_ALTERNATIONS = 5
_MAX_SETBACKS, _MIN_PICTURES = 1000, 3
_PAUSE_NS = 1_000_000_000  # no odometry is interpolated across it
_NUM_NEIGHBOURS = 5


@dataclass(frozen=True)
class Clock:
    """Hold the header times of a topic in the order of writing, and what is added to each. Without
    any, the clock was never set back."""

    places: list[Place] = field(default_factory=list)
    t_ns: list[int] = field(default_factory=list)
    shifts: list[int] = field(default_factory=list)
    starts: list[int] = field(default_factory=list)

    @staticmethod
    def of_times(stamped: list[tuple[Place, int, int]]) -> Clock:
        """Return the clock of a topic. Each message has its place in the bag, its header time and
        its time of writing."""
        ordered = sorted(stamped)
        t_ns = [stamp for _, stamp, _ in ordered]
        starts = _find_setbacks(
            np.array(t_ns, dtype=np.int64), np.array([written for *_, written in ordered])
        )
        if not starts:
            return Clock()
        shifts, end = [0] * starts[0], max(t_ns[: starts[0]])
        for start, stop in pairwise([*starts, len(t_ns)]):
            shift = end + _PAUSE_NS - min(t_ns[start:stop])
            shifts += [shift] * (stop - start)
            end = max(t_ns[start:stop]) + shift
        return Clock([place for place, *_ in ordered], t_ns, shifts, starts)

    def unwrap(self, place: Place, t_ns: int) -> int:
        """Return the time of a message of any topic, on a clock that was not set back. The message
        belongs to the part of the picture, among those written next to it, with the nearest
        time."""
        if not self.starts:
            return t_ns
        at = bisect.bisect_left(self.places, place)
        rows = range(max(0, at - _NUM_NEIGHBOURS), min(len(self.places), at + _NUM_NEIGHBOURS))
        return t_ns + self.shifts[min(rows, key=lambda k: (abs(self.t_ns[k] - t_ns), abs(k - at)))]

    def describe(self, name: str) -> str:
        """Describe the first time that the clock was set back."""
        start = self.starts[0]
        seconds = (self.t_ns[start - 1] - self.t_ns[start]) / 1e9
        return (
            f"the clock of {name} goes back by {seconds:.3g} s after {start} of {len(self.t_ns)}"
            " pictures, as of a simulator that is reset or a bag that is played in a loop; the"
            f" {len(self.starts) + 1} parts are put one after the other"
        )


def _find_setbacks(t_ns: Int64[np.ndarray, " n"], written_ns: Int64[np.ndarray, " n"]) -> list[int]:
    """Return the rows at which the clock was set back."""
    setbacks, start = list[int](), 0
    drops = np.flatnonzero(np.diff(t_ns) < -_MIN_SETBACK_NS) + 1
    for row in drops.tolist() if len(drops) <= _MAX_SETBACKS else []:
        before, after = t_ns[start:row], t_ns[row:]
        # the recorder's own clock tells parts from files that were joined in another order
        is_later = written_ns[start:row].max() < written_ns[row:].min()
        is_before = len(after) >= _MIN_PICTURES and after[:_MIN_PICTURES].max() < before.min()
        if _do_alternate(before, after) or (is_later and is_before):
            setbacks.append(row)
            start = row
    return setbacks


def _do_alternate(before: Int64[np.ndarray, " n"], after: Int64[np.ndarray, " m"]) -> bool:
    """Return whether later messages lie between earlier ones. Messages of one clock that were
    written in another order do not."""
    before, after = before[before >= after[0]], after[after <= before.max()]
    is_after = np.repeat([False, True], [len(before), len(after)])
    in_time = is_after[np.argsort(np.concatenate([before, after]), kind="stable")]
    return bool(np.count_nonzero(np.diff(in_time)) >= _MIN_ALTERNATIONS)
