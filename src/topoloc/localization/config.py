"""Settings of all localization steps. Values fitted to data are in `fitted_weights.py`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

from topoloc.bounds import Above, AtLeast, Between
from topoloc.features.config import MatchingConfig
from topoloc.features.feature_types import FeatureType
from topoloc.geometry.absolute_pose import AbsolutePoseConfig
from topoloc.localization.evidence import EvidenceConfig
from topoloc.localization.guided import GuidedConfig
from topoloc.localization.map_facts.correlated_errors import CorrelatedErrorsConfig


@dataclass(frozen=True)
class SimilarPlacesConfig:
    """Configure the separate search in similar places (perceptual aliasing)."""

    num_ranked: Annotated[int, Between(1, 100_000)] = 48
    """Number of nodes that the coarse localizer ranks, including the candidates. Similar places are
    selected from them."""
    min_score_share: Annotated[tuple[float, float], Between(0, 1)] = (0.85, 0.4)
    """Minimum score of a similar place, as a share of the best score: if the pose is clear, and if
    it is not."""
    reach: Annotated[float, AtLeast(0)] = 5.0
    """Nodes within this many D_thresh of a pose (Eq. 1) belong to its place. Similar places are
    farther away."""
    max_groups: Annotated[int | None, Between(0, 1000)] = None
    """Maximum number of similar places that are searched. 0 disables this step. Unset: the default
    of the feature type."""
    min_inlier_share: Annotated[float, Between(0, 1)] = 0.25
    """Minimum inliers of a similar place, as a share of the best pose's inliers. A place with
    fewer, from the image's strongest features, is not refined."""


@dataclass(frozen=True)
class NodeViewpointsConfig:
    """Configure node viewpoints as pose priors, used if no pose is clear."""

    num_nodes: Annotated[int | None, Between(0, 10_000)] = None
    """Number of best-ranked nodes that are compared one by one. 0 disables this step. Unset: 24, or
    0 for features without size and angle, for which the comparison is weak."""
    shift_px: Annotated[float, Above(0)] = 12.0
    """Maximum difference between the displacements of consistent matches, in pixels of an image
    whose longer side is 640. Scales with the image size."""
    min_alike: Annotated[int, AtLeast(0)] = 8
    """A node is accepted if at least this many matches are consistent, plus `chance_share` of its
    matches."""
    chance_share: Annotated[float, Between(0, 1)] = 0.09
    """Share of a node's matches that is added to `min_alike`."""
    max_fits: Annotated[int, Between(1, 1000)] = 6
    """Number of accepted nodes, those with the most consistent matches, for which a pose is
    fitted."""
    max_poses: Annotated[int, Between(1, 1000)] = 4
    """Number of fitted poses, those with the most inliers, that become proposals."""
    max_iterations: Annotated[int, Between(1, 1_000_000)] = 500
    """RANSAC iterations for each fit."""
    matching: GuidedConfig = field(default_factory=lambda: GuidedConfig(radius_px=64.0))
    """Guided matching around the pixels where the node saw its points."""


@dataclass(frozen=True)
class VirtualViewSearchConfig:
    """Configure the search in virtual views."""

    num_places: Annotated[int, Between(0, 10_000)] = 8
    """Number of places along the trajectory that are compared with both side views. 0 disables this
    step."""
    apart: Annotated[float, Above(0)] = 2.0
    """Minimum distance between these places, in D_thresh."""
    min_agreeing: Annotated[int, AtLeast(3)] = 8
    """Minimum number of matches, over both views, that must agree on one pose to recognise a
    place."""
    num_hypotheses: Annotated[int, Between(1, 1000)] = 6
    """Maximum number of pose proposals that are refined."""
    num_nodes: Annotated[int, Between(1, 1000)] = 4
    """Number of virtual views around a pose whose points are searched in each side view."""
    min_distance: Annotated[float, AtLeast(0)] = 5.0
    """Poses within this many D_thresh (Eq. 1) of a node are skipped, because that node would have
    found them."""
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    guided: GuidedConfig = field(default_factory=GuidedConfig)
    rounds: Annotated[tuple[tuple[float, float], ...], AtLeast(0)] = (
        (0.0, 12.0),
        (0.0, 6.0),
        (30.0, 6.0),
        (25.0, 3.0),
        (25.0, 3.0),
    )
    """Search radius and maximum reprojection error of each round, pixels. Each round matches and
    fits in turn. Radius 0 uses the unguided matches, because guided ones bias an inaccurate
    pose."""
    min_found: Annotated[int, AtLeast(4)] = 20
    """Minimum number of map points found at their predicted pixels."""
    clear_log_odds: Annotated[float, Between(-100, 100)] = 2.5
    """Virtual views are skipped if a pose of the nodes has higher log-odds."""


@dataclass(frozen=True)
class LocalizerConfig:
    """Configure the localizer. The features are those that the map was built with."""

    kinds: tuple[str, ...] | None = None
    """Feature types of the map to use, in order. Each next one is used if the pose is still unclear
    (None: all whose networks are installed)."""
    coarse: str | None = None
    """Name of the map's coarse localizer (None: the map's default)."""
    max_ms: Annotated[float | None, AtLeast(0)] = None
    """Time limit in milliseconds, after which no further hypothesis is tested (None: no limit)."""
    num_candidates: Annotated[int, Between(1, 10_000)] = 4
    """Number of nodes whose points are pooled. 1 is the paper's single node."""
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    guided: GuidedConfig = field(default_factory=GuidedConfig)
    pose: AbsolutePoseConfig = field(
        default_factory=lambda: AbsolutePoseConfig(
            max_reprojection_error_px=8.0, max_iterations=1000
        )
    )
    num_first_features: Annotated[int, AtLeast(1)] = 320
    """Number of the image's strongest features that are matched first. The rest is matched only if
    these give fewer than `num_clear_inliers` inliers."""
    num_clear_inliers: Annotated[int, AtLeast(0)] = 40
    """If the first pose has fewer inliers, its surroundings are searched twice."""
    num_chance_inliers: Annotated[int, AtLeast(0)] = 7
    """Number of inliers that can agree by chance. If the first matches give no more, and no
    viewpoint stands out, similar places are not searched."""
    min_matches: Annotated[int, AtLeast(4)] = 8
    """Minimum number of first matches for which a pose is estimated."""
    evidence: EvidenceConfig = field(default_factory=EvidenceConfig)
    look_alikes: SimilarPlacesConfig = field(default_factory=SimilarPlacesConfig)
    viewpoints: NodeViewpointsConfig = field(default_factory=NodeViewpointsConfig)
    max_repetitions: Annotated[int, Between(0, 1000)] = 64
    """Maximum number of other poses that are tested in a repetitive place."""
    walls: VirtualViewSearchConfig = field(default_factory=VirtualViewSearchConfig)
    correlated_errors: CorrelatedErrorsConfig = field(default_factory=CorrelatedErrorsConfig)
    max_finer: Annotated[float, AtLeast(1)] = 1.15
    """An image is reduced to the focal length (pixels) of the map's finest camera if its own is
    larger by this factor. At larger sizes its key points match none of the map."""
    max_side_px: Annotated[int, Between(64, 100_000)] = 1600
    """Larger images are reduced to this width or height first. A larger size costs time and memory
    without a gain."""

    def for_feature_type(self, kind: FeatureType) -> LocalizerConfig:
        """Return the settings with unset thresholds filled in for this feature type."""
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
