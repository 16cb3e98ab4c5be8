"""The time of the robot (this machine's, that of /clock, or that of another machine's stamps), and
the content of /diagnostics: level, one sentence, and figures."""

from __future__ import annotations

import math
import time
from collections import deque
from dataclasses import dataclass, field


class RobotClock:
    """Hold the time of the stamps.

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
    def is_waiting(self) -> bool:
        """Return whether no time has come on /clock yet."""
        return self._is_simulated and not self._simulated_ns

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
        if self.is_waiting:
            return "no time on /clock; start the simulation, or leave out use_sim_time"
        if not self.is_foreign:
            return None
        side = "behind" if self.offset > 0 else "ahead of"
        return (
            f"the stamps of the images are {abs(self.offset):.2f} s {side} this clock; synchronize"
            " the machines (chrony), or set use_sim_time"
        )

    def _local_ns(self) -> int:
        return self._simulated_ns if self._is_simulated else time.time_ns()


@dataclass(eq=False)
class Health:
    """Hold the figures of the last answer. Times are seconds of any clock that goes on."""

    answer_at: float = -math.inf
    evidence_at: float = -math.inf
    is_contradicted: bool = False
    state: str = "lost"
    probability: float = 0.0
    latency_ms: float = 0.0
    num_dropped: int = 0
    num_jumps: int = 0
    faults: dict[str, str] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)

    @property
    def is_blind(self) -> bool:
        """Return whether no image can be used, and the stream has ended."""
        return self.state == "lost" and "image" in self.faults

    def judge(self, now: float) -> tuple[int, str]:
        """Return the level (0 OK, 1 WARN, 2 ERROR) and a sentence."""
        ok, warn, error = range(3)
        warn_after, lost_after = 1.0, 10.0  # seconds without evidence
        silence, faults = now - self.evidence_at, tuple(self.faults.values())  # of other threads
        fault = faults[0] if faults else None
        if math.isinf(silence):
            return error, fault or "not localized yet"
        if silence > lost_after or self.is_blind:
            return error, fault or f"lost: no evidence for {silence:.1f} s"
        if fault is not None:
            return warn, fault
        if self.is_contradicted:
            return warn, "the images contradict the pose"
        if silence > warn_after:
            return warn, f"no evidence for {silence:.1f} s; the pose is that of odometry"
        return ok, "localized"

    def values(self, now: float, offset: float) -> dict[str, str]:
        """Return the figures as texts. `offset` is that of the clock, seconds."""
        return {
            "state": self.state,
            "probability": f"{self.probability:.3f}",
            "latency_ms": f"{self.latency_ms:.0f}",
            "dropped_images": f"{self.num_dropped}",
            "answer_age_s": f"{now - self.answer_at:.2f}",
            "evidence_age_s": f"{now - self.evidence_at:.2f}",
            "clock_offset_s": f"{offset:.3f}",
            "jumps": f"{self.num_jumps}",
        } | self.notes
