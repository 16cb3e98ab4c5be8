"""Settings of the odometry of a single camera (`monocular_odometry.py`)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from topoloc.bounds import Above, AtLeast, Between
from topoloc.points.point_tracking import TrackingConfig
from topoloc.slam.bundle_adjustment import BundleConfig
from topoloc.slam.step_estimation import OdometryConfig


@dataclass(frozen=True)
class MonocularOdometryConfig:
    """Configure the initialisation of a sub-map and the triangulation of points."""

    odometry: OdometryConfig = field(
        default_factory=lambda: OdometryConfig(
            tracking=TrackingConfig(num_corners=1500, patch_half_px=7),
            bundle=BundleConfig(max_steps=12),
            window=20,
            held=10,
            min_tracked=15,
        )
    )
    """More points are tracked than with a stereo camera, because few of them survive until they are
    triangulated. The window is longer, because it alone preserves the scale."""
    max_side_px: Annotated[int, Between(64, 16_384)] = 800
    """Images are reduced to this width or height for point tracking."""
    start_motion: Annotated[float, Above(0)] = 0.03
    """Minimum median displacement of the points to start a sub-map, as a share of the image
    width."""
    start_points: Annotated[int, AtLeast(8)] = 50
    """Minimum number of triangulated points to start a sub-map."""
    start_share: Annotated[float, Between(0, 1)] = 0.2
    """If fewer than this share of its points are left, the first image is replaced by a later
    one."""
    max_beginning: Annotated[int, Between(2, 10_000)] = 60
    """The first image is also replaced after this many frames, because a camera at rest gives no
    depth."""
    max_return_px: Annotated[float, Above(0)] = 0.7
    """Maximum error of a point tracked forwards and backwards, pixels."""
    clear_px: Annotated[float, Above(0)] = 0.05
    """Tracking uncertainty (pixels, from the appearance difference taken as noise) at which a point
    has an error of `sigma_px`. Otherwise the error scales with the square of the ratio, because
    points that slide along an edge differ more than noise suggests."""
    min_parallax_deg: Annotated[float, Above(0)] = 1.0
    """Minimum angle between the rays of a landmark, degrees."""
    min_rays: Annotated[int, Between(2, 100)] = 2
    """Minimum number of key frames that see a landmark."""
    max_triangulation_px: Annotated[float, Above(0)] = 1.5
    """Maximum reprojection error of a new landmark in all its key frames, pixels."""
