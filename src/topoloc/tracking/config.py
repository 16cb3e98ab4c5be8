"""Settings of the tracker."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from topoloc.bounds import Above
from topoloc.tracking.motion import MotionConfig


@dataclass(frozen=True)
class HypothesesConfig:
    """Configure the gating, the weights and the extent of predictions."""

    motion: MotionConfig = field(default_factory=MotionConfig)


@dataclass(frozen=True)
class TrackerConfig:
    """Configure the schedule of full localizations, the tracking and the smoothing."""

    mode: Literal["motion", "paper"] = "motion"
    """`motion`: predict, track and filter. `paper`: localize each image alone, and copy the
    preceding pose if the new one is too far from it."""
    max_jump: Annotated[float, Above(0)] = 1.0
    """Mode "paper": maximum distance between two consecutive poses, metres (the paper: 1 to 5, by
    the size of the place)."""
    hypotheses: HypothesesConfig = field(default_factory=HypothesesConfig)
    simulated: bool = False
    """The images are of a simulator without noise: equal ones show that the camera stands."""
