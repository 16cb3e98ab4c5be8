"""Settings of the tracker."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from topoloc.bounds import Above, AtLeast, Between
from topoloc.tracking.point_tracker import PointTrackerConfig
from topoloc.tracking.pose_hypotheses import HypothesesConfig
from topoloc.tracking.pose_window import PoseWindowConfig


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
    following: PointTrackerConfig = field(default_factory=PointTrackerConfig)
    window: PoseWindowConfig = field(default_factory=PoseWindowConfig)
    max_side_px: Annotated[int, Between(64, 16_384)] = 800
    """Images are reduced to this width or height for point tracking."""
    localize_every: Annotated[float, AtLeast(0)] = 0.25
    """Interval of full localizations, seconds."""
    min_share_left: Annotated[float, Between(0, 1)] = 0.6
    """An image is also localized in full if the share of points still tracked is below this."""
    max_shift: Annotated[float, Above(0)] = 0.04
    """An image is also localized in full if the points moved by more than this share of the image
    width."""
    retry_after: Annotated[float, AtLeast(0)] = 0.1
    """Minimum seconds between two full localizations while the points are tracked."""
    max_doubt: Annotated[float, Above(0)] = 0.3
    """Maximum direction uncertainty of the prediction (three sigma, radians). Above it, coarse
    retrieval is used."""
    floor_share: Annotated[float, AtLeast(0)] = 0.001
    """Sigma added to the noise of a localization, as a share of the points' depth and in
    radians."""
    reach: Annotated[float, Above(0)] = 2.0
    """Motion over which map errors are correlated (to 1/e). It is the distance in depths of the
    points, plus the rotation in radians."""
    blend_time: Annotated[float, Above(0)] = 0.2
    """Time constant (to 1/e, seconds) of the correction of the smoothed pose by a new localization.
    It prevents jumps."""
    followed_share: Annotated[float, AtLeast(0)] = 0.05
    """Sigma of a tracked motion, as a share of its translation and rotation, in addition to the
    noise of the points."""
