"""The time of the robot: this machine's, that of /clock, or that of another machine's stamps."""

from __future__ import annotations

import time
from collections import deque


class RobotClock:
    """Tell the time of the stamps.

    Args:
        is_simulated: the time is that of `set_simulated`.
        max_offset: seconds between this clock and the stamps that mean another clock.
    """

    def __init__(self, is_simulated: bool = False, max_offset: float = 0.5) -> None:
        self._is_simulated, self._max_offset = is_simulated, max_offset
        self._simulated_ns = 0
        self._delays_ns: deque[int] = deque(maxlen=50)

    def set_simulated(self, t_ns: int) -> None:
        """Set the time of /clock."""
        self._simulated_ns = t_ns

    def reset(self) -> None:
        """Forget the stamps, because the clock was set back."""
        self._delays_ns.clear()

    def observe(self, t_ns: int) -> None:
        """Take the stamp of an image that has just arrived."""
        self._delays_ns.append(self._local_ns() - t_ns)

    @property
    def offset(self) -> float:
        """Return the seconds that this clock is ahead of the stamps, with the shortest delay."""
        return min(self._delays_ns, key=abs) / 1e9 if self._delays_ns else 0.0

    @property
    def is_foreign(self) -> bool:
        """Return whether the stamps are of another clock."""
        least = 3  # images; the first ones have waited
        return len(self._delays_ns) >= least and abs(self.offset) > self._max_offset

    def now_ns(self) -> int:
        """Return the time of the stamps. 0: not known yet."""
        now_ns = self._local_ns()
        return now_ns - round(1e9 * self.offset) if self.is_foreign else now_ns

    def describe_fault(self) -> str | None:
        """Return what is wrong with the clock, in one sentence, or None."""
        if self._is_simulated and not self._simulated_ns:
            return "no time on /clock; start the simulation, or set use_sim_time = false"
        if not self.is_foreign:
            return None
        side = "behind" if self.offset > 0 else "ahead of"
        return (
            f"the stamps of the images are {abs(self.offset):.2f} s {side} this clock; synchronize"
            " the machines (chrony), or set use_sim_time"
        )

    def _local_ns(self) -> int:
        return self._simulated_ns if self._is_simulated else time.time_ns()
