"""When a frame is tracked, when it becomes a key frame, and how far a motion is trusted."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from topoloc.bounds import Above, AtLeast, Between
from topoloc.geometry.absolute_pose import AbsolutePoseConfig
from topoloc.slam.bundle import BundleConfig
from topoloc.slam.disparity import DisparityConfig
from topoloc.slam.motion_prediction import PredictionConfig
from topoloc.slam.place_matching import PlaceMatchingConfig
from topoloc.slam.tracking import TrackingConfig


@dataclass(frozen=True)
class OdometryConfig:
    """When a frame is tracked, and when it becomes a key frame."""

    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    prediction: PredictionConfig = field(default_factory=PredictionConfig)
    disparity: DisparityConfig = field(default_factory=DisparityConfig)
    pose: AbsolutePoseConfig = field(
        default_factory=lambda: AbsolutePoseConfig(max_reprojection_error_px=2.0, sigma_px=0.5, max_iterations=300, min_iterations=20)
    )
    bundle: BundleConfig = field(default_factory=BundleConfig)
    places: PlaceMatchingConfig = field(default_factory=PlaceMatchingConfig)
    sigma_px: Annotated[float, Above(0)] = 0.3
    """Standard deviation of a tracked point."""
    sigma_bias_px: Annotated[float, Above(0)] = 1.0
    """How wrong all disparities together may be before the recording has shown by how much."""
    min_disparity_px: Annotated[float, Above(0)] = 0.5
    """What seems further away than this becomes no landmark."""
    sigma_landmark_px: Annotated[float, Above(0)] = 0.25
    """Uncertainty of a landmark's depth, as a disparity."""
    window: Annotated[int, Between(1, 1000)] = 8
    """Key frames that are adjusted together."""
    held: Annotated[int, Between(0, 1000)] = 5
    """Key frames before these that hold them in place."""
    min_tracked: Annotated[int, AtLeast(4)] = 25
    """Points that agree on a pose; a frame with fewer is lost."""
    min_tracked_share: Annotated[float, Between(0, 1)] = 0.35
    """Share of the points followed that must agree; a frame with fewer is lost."""
    keyframe_share: Annotated[float, Between(0, 1)] = 0.7
    """A key frame is due when so few of the last one's points are left."""
    keyframe_motion: Annotated[float, Above(0)] = 0.03
    """... or when they have moved in the picture by this share of its width (median)."""
    min_gap_share: Annotated[float, Between(0, 1)] = 0.5
    """After a gap, a step that the motion does not let expect is believed where this share of the points is found again."""
    start_spacing_px: Annotated[float, Above(0)] = 25.0
    """Whether the last picture looks alike from elsewhere is tried from places this far apart (median over the points) ..."""
    max_starts: Annotated[int, Between(0, 1000)] = 16
    """... so many to either side along the motion at most, ..."""
    repeat_depth: Annotated[float, AtLeast(0)] = 1.0
    """... and as far as this share of the median depth, as the way since the last frame, or as the prediction is uncertain."""
    repeat_share: Annotated[float, Between(0, 1)] = 0.3
    """It does where this share of the points that should be in the picture agree."""
    max_repeats: Annotated[int, Between(0, 1000)] = 8
    """A step may then be off by so many of these repeats."""
    same_step: Annotated[float, Above(0)] = 0.04
    """Steps that differ by less than this share of the median depth, and radians, are the same."""
    max_lost_tracked: Annotated[int, AtLeast(0)] = 3
    """The points of the last frame that was tracked are sought in so many more."""
    max_lost_frames: Annotated[int, AtLeast(0)] = 10
    """A camera that is lost for longer starts a new sub-map."""
    places_asked: Annotated[int, Between(0, 1000)] = 6
    """The last places in which a camera that is lost is sought."""
    place_distance: Annotated[float, AtLeast(0)] = 0.1
    """A key frame keeps what it looks like (for loops) when it is this share of the median depth from the last that did ..."""
    place_angle_deg: Annotated[float, AtLeast(0)] = 8.0
    """... or turned by this angle."""
