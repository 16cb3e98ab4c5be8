"""How a query is answered: the settings of all steps. What is fitted to data is no setting
(`fitted_weights.py`)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

from topoloc.bounds import Above, AtLeast, Between
from topoloc.features.feature_types import FeatureType
from topoloc.features.matching import MatchingConfig
from topoloc.geometry.absolute_pose import AbsolutePoseConfig
from topoloc.localization.evidence import EvidenceConfig
from topoloc.localization.guided import GuidedConfig
from topoloc.localization.map_facts.correlated_errors import CorrelatedErrorsConfig


@dataclass(frozen=True)
class SimilarPlacesConfig:
    """When another part of the map that looks like the image is asked on its own."""

    num_ranked: Annotated[int, Between(1, 100_000)] = 48
    """Nodes that the coarse localizer ranks, the candidates among them; look-alikes come from
    these."""
    min_score_share: Annotated[tuple[float, float], Between(0, 1)] = (0.85, 0.4)
    """A look-alike's score is at least this share of the best one's: where the pose is clear, and
    where it is not."""
    reach: Annotated[float, AtLeast(0)] = 5.0
    """Nodes within so many D_thresh of a pose (Eq. 1) belong to it; look-alikes are farther
    away."""
    max_groups: Annotated[int | None, Between(0, 1000)] = None
    """Parts of the map that are asked on their own, at most; 0 asks none. Unset: what suits the
    kind of features."""
    min_inlier_share: Annotated[float, Between(0, 1)] = 0.25
    """A part whose points agree with the image's strongest features in fewer than this share of
    what agrees with the believed pose is left at that."""


@dataclass(frozen=True)
class NodeViewpointsConfig:
    """Where an image that is not clear is compared with what nodes saw."""

    num_nodes: Annotated[int | None, Between(0, 10_000)] = None
    """Nodes of the best coarse rank that are compared, one by one; 0 compares none. Unset: 24, none
    for features without size and angle, which tell little so."""
    shift_px: Annotated[float, Above(0)] = 12.0
    """Matches whose displacements differ by less than this agree, in an image whose longer side is
    640 pixels; grows with that."""
    min_alike: Annotated[int, AtLeast(0)] = 8
    """A node is followed up where so many matches agree ..."""
    chance_share: Annotated[float, Between(0, 1)] = 0.09
    """... and this share of all its matches more."""
    max_fits: Annotated[int, Between(1, 1000)] = 6
    """Nodes whose matches are asked for a pose, those that agree most."""
    max_poses: Annotated[int, Between(1, 1000)] = 4
    """Of the poses found, those with the most inliers are looked into."""
    max_iterations: Annotated[int, Between(1, 1_000_000)] = 500
    """Of RANSAC, for each of them."""
    matching: GuidedConfig = field(default_factory=lambda: GuidedConfig(radius_px=64.0))
    """How widely points are sought around where the node saw them."""


@dataclass(frozen=True)
class VirtualViewSearchConfig:
    """How the walls along the way are asked."""

    num_places: Annotated[int, Between(0, 10_000)] = 8
    """Places along the way that are compared with both views; 0 asks none."""
    apart: Annotated[float, Above(0)] = 2.0
    """They are so many D_thresh apart."""
    min_agreeing: Annotated[int, AtLeast(3)] = 8
    """Matches of both views with the walls of a place that must agree on one pose, for it to be
    recognised."""
    num_hypotheses: Annotated[int, Between(1, 1000)] = 6
    """First poses that are looked into."""
    num_nodes: Annotated[int, Between(1, 1000)] = 4
    """Side nodes whose points are sought in each view around a pose."""
    min_distance: Annotated[float, AtLeast(0)] = 5.0
    """Poses within so many D_thresh (Eq. 1) of a node would have been found by that node."""
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    guided: GuidedConfig = field(default_factory=GuidedConfig)
    rounds: Annotated[tuple[tuple[float, float], ...], AtLeast(0)] = (
        (0.0, 12.0),
        (0.0, 6.0),
        (30.0, 6.0),
        (25.0, 3.0),
        (25.0, 3.0),
    )
    """Matches and pose in turn: search radius and largest error, pixels. Radius 0 are the unguided
    matches: guided ones draw a pose that is not yet right towards itself."""
    min_found: Annotated[int, AtLeast(4)] = 20
    """Map points found where the pose says they must be, at least."""
    clear_log_odds: Annotated[float, Between(-100, 100)] = 2.5
    """Where there is more for a pose of the nodes, the walls are not asked."""


@dataclass(frozen=True)
class LocalizerConfig:
    """How a query is answered. The features are those that the map was built with."""

    kinds: tuple[str, ...] | None = None
    """Which of the map's kinds of features are asked, in turn, each where the one before leaves the
    pose unclear (None: all whose networks are there)."""
    coarse: str | None = None
    """Which of the map's coarse localizers is asked (None: the map's default)."""
    max_ms: Annotated[float | None, AtLeast(0)] = None
    """After so many milliseconds no further hypothesis is sought (None: all are)."""
    num_candidates: Annotated[int, Between(1, 10_000)] = 4
    """Nodes whose points are pooled; 1 is the paper's single node."""
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    guided: GuidedConfig = field(default_factory=GuidedConfig)
    pose: AbsolutePoseConfig = field(
        default_factory=lambda: AbsolutePoseConfig(
            max_reprojection_error_px=8.0, max_iterations=1000
        )
    )
    num_first_features: Annotated[int, AtLeast(1)] = 320
    """The image's strongest features are matched first; the rest only where these give fewer
    inliers than the next number."""
    num_clear_inliers: Annotated[int, AtLeast(0)] = 40
    """With fewer inliers of the first pose, its surroundings are looked at twice."""
    num_chance_inliers: Annotated[int, AtLeast(0)] = 7
    """Fewer agree on a pose anywhere: where the first matches have no more, and no viewpoint stands
    out, look-alikes are not asked."""
    min_matches: Annotated[int, AtLeast(4)] = 8
    """With fewer first matches no pose is sought."""
    evidence: EvidenceConfig = field(default_factory=EvidenceConfig)
    look_alikes: SimilarPlacesConfig = field(default_factory=SimilarPlacesConfig)
    viewpoints: NodeViewpointsConfig = field(default_factory=NodeViewpointsConfig)
    max_repetitions: Annotated[int, Between(0, 1000)] = 64
    """Where a place repeats itself, so many other poses are looked into at most."""
    walls: VirtualViewSearchConfig = field(default_factory=VirtualViewSearchConfig)
    correlated_errors: CorrelatedErrorsConfig = field(default_factory=CorrelatedErrorsConfig)
    max_finer: Annotated[float, AtLeast(1)] = 1.15
    """An image of more than so many times the pixels a radian (focal length in pixels) of the map's
    finest camera is reduced to that camera's first: at larger sizes its key points find none alike
    in the map."""
    max_side_px: Annotated[int, Between(64, 100_000)] = 1600
    """Larger images are reduced to this width or height first: nothing is gained from more, but
    time and memory."""

    def for_feature_type(self, kind: FeatureType) -> LocalizerConfig:
        """With the thresholds of this kind of features where none are set."""
        walls, viewpoints, look_alikes = self.walls, self.viewpoints, self.look_alikes
        has_shape = kind.has_scale and kind.has_angle
        num_nodes = (
            viewpoints.num_nodes if viewpoints.num_nodes is not None else 24 if has_shape else 0
        )
        max_groups = (
            look_alikes.max_groups if look_alikes.max_groups is not None else 3 if has_shape else 8
        )
        return replace(
            self,
            matching=self.matching.resolved(kind.ratio),
            guided=self.guided.resolved(kind),
            pose=self.pose
            if self.pose.sigma_px is not None
            else replace(self.pose, sigma_px=kind.sigma_px),
            look_alikes=replace(look_alikes, max_groups=max_groups),
            viewpoints=replace(
                viewpoints,
                num_nodes=num_nodes,
                matching=viewpoints.matching.resolved(kind, kind.distant),
            ),
            walls=replace(
                walls,
                matching=walls.matching.resolved(kind.virtual_view_ratio),
                guided=walls.guided.resolved(kind),
            ),
        )
