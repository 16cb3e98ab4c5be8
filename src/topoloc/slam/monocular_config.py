"""How a single camera's odometry (`monocular_odometry.py`) works."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from topoloc.bounds import Above, AtLeast, Between
from topoloc.points.point_tracking import TrackingConfig
from topoloc.slam.bundle_adjustment import BundleConfig
from topoloc.slam.step_estimation import OdometryConfig


@dataclass(frozen=True)
class MonocularOdometryConfig:
    """When a stretch begins, and when a point has shown its depth."""

    odometry: OdometryConfig = field(
        default_factory=lambda: OdometryConfig(
            tracking=TrackingConfig(num_corners=1500, patch_half_px=7),
            bundle=BundleConfig(max_steps=12),
            window=20,
            held=10,
            min_tracked=15,
        )
    )
    """More is followed than by a stereo camera, for few corners live until they have shown their
    depth; and what is adjusted together reaches further back, for nothing but that holds the
    unit."""
    max_side_px: Annotated[int, Between(64, 16_384)] = 800
    """Points are followed in pictures reduced to this width or height."""
    start_motion: Annotated[float, Above(0)] = 0.03
    """A stretch may begin where points have moved by this share of the picture's width (median)
    ..."""
    start_points: Annotated[int, AtLeast(8)] = 50
    """... and so many of them show their depth."""
    start_share: Annotated[float, Between(0, 1)] = 0.2
    """With fewer of its points left, the first picture is given up for a later one."""
    max_beginning: Annotated[int, Between(2, 10_000)] = 60
    """... as it is after so many frames: who stands still shows no depth."""
    max_return_px: Annotated[float, Above(0)] = 0.7
    """A point followed there and back must come back to within so many pixels."""
    clear_px: Annotated[float, Above(0)] = 0.05
    """Where what does not look alike, taken for noise, makes a point's place so uncertain, it is
    off by `sigma_px`; elsewhere by the square of the ratio as much, for what slides along an edge
    looks less alike than noise alone would make it."""
    min_parallax_deg: Annotated[float, Above(0)] = 1.0
    """Angle between rays from which on a point is a landmark ..."""
    min_rays: Annotated[int, Between(2, 100)] = 2
    """... if so many key frames have seen it ..."""
    max_triangulation_px: Annotated[float, Above(0)] = 1.5
    """... and its rays meet to within so many pixels in all of them."""
