"""What /diagnostics says about the localization: level, one sentence, and figures."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from topoloc.apps.robots.config import RobotConfig

OK, WARN, ERROR = range(3)
_NEVER = -math.inf


@dataclass(eq=False)
class Health:
    """Hold the figures of the last answer. Times are seconds of any clock that goes on."""

    answer_at: float = _NEVER
    evidence_at: float = _NEVER
    is_contradicted: bool = False
    state: str = "lost"
    probability: float = 0.0
    latency_ms: float = 0.0
    num_dropped: int = 0
    num_jumps: int = 0
    faults: dict[str, str] = field(default_factory=dict)

    def judge(self, now: float, config: RobotConfig) -> tuple[int, str]:
        """Return the level and a sentence."""
        silence, fault = now - self.evidence_at, next(iter(self.faults.values()), None)
        if math.isinf(silence):
            return ERROR, fault or "not localized yet"
        if silence > config.lost_after:
            return ERROR, fault or f"lost: no evidence for {silence:.1f} s"
        if fault is not None:
            return WARN, fault
        if self.is_contradicted:
            return WARN, "the images contradict the pose"
        if silence > config.warn_after:
            return WARN, f"no evidence for {silence:.1f} s; the pose is that of odometry"
        return OK, "localized"

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
        }
