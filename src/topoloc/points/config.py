"""Define the settings of points, without the code that reads them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from topoloc.bounds import Above, AtLeast, Between
from topoloc.features.config import MatchingConfig


@dataclass(frozen=True)
class MetricPointsConfig:
    """Hold the settings for the 3-D positions of features."""

    max_relative_sigma: Annotated[float, Above(0)] = 0.3
    """Points whose depth has a larger standard deviation than this fraction of it are dropped."""
    correlation_half_px: Annotated[int, Between(1, 50)] = 5
    """Stereo: half side of the window that is correlated along the row."""
    min_correlation: Annotated[float, Between(-1, 1)] = 0.8
    """Stereo: minimum normalised correlation of the two images."""
    max_second_correlation: Annotated[float, Between(0, 1)] = 0.97
    """Stereo: a point is ambiguous if a second place on the row reaches this fraction of the best
    correlation."""
    min_sigma_disparity_px: Annotated[float, Above(0)] = 0.12
    """Stereo: standard deviation that calibration and interpolation leave even at perfect
    correlation."""
    max_depth_step: Annotated[float, Between(0, 1)] = 0.05
    """RGB-D: maximum spread of depth over the 5x5 neighbourhood, as a fraction of depth. A larger
    spread is a depth edge."""
    sigma_scale: Annotated[float, Above(0)] = 0.4
    """Standard deviation of a key point's position, in units of its scale."""


@dataclass(frozen=True)
class MotionTriangulationConfig:
    """Hold the settings of triangulation from single images with known poses."""

    steps: Annotated[tuple[float, ...], Above(0)] = (1.0, 2.0, 4.0, 7.0, 12.0, 20.0, 34.0, 55.0)
    """Distances of the other images, in units of the median distance of consecutive images."""
    max_turn: Annotated[float, Between(0, 3.2)] = 0.6
    """Maximum angle between the viewing directions of two images, radians. Beyond it hardly any
    feature matches."""
    matching: MatchingConfig = field(default_factory=lambda: MatchingConfig(ratio=0.85))
    gate: Annotated[float, Above(0)] = 3.0
    """Maximum distance of a match from its epipolar line, and of two depths from each other, in
    standard deviations."""
    pose_sigma_px: Annotated[float, AtLeast(0)] = 0.5
    """Standard deviation that pose errors add to that of a key point, pixels."""
    min_pictures: Annotated[int, Between(1, 100)] = 2
    """Minimum number of other images whose depths of a point agree."""
