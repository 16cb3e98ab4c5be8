"""Settings of all localization steps. Values fitted to data are in `fitted_weights.py`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar, Literal

from topoloc.bounds import AtLeast, Between
from topoloc.features.feature_types import FeatureType
from topoloc.features.features import MatchingConfig
from topoloc.geometry.absolute_pose import AbsolutePoseConfig
from topoloc.json_data import OneLine
from topoloc.localization.guided import GuidedConfig


@dataclass(frozen=True)
class EvidenceConfig:
    """Configure the tolerance of a right pose and the conditions for reporting one."""

    max_translation: ClassVar[float] = 0.25
    """Maximum position error of a right pose, metres, on which the weights were fitted.
    `depth_share` of the distance of the seen points replaces it if that is less."""
    max_rotation_deg: ClassVar[float] = 2.0
    """Maximum rotation error of a right pose, degrees, on which the weights were fitted."""
    tolerance: Annotated[tuple[float, float] | None, Between(1e-3, 1000)] = None
    """Maximum errors of a right pose, metres and degrees, if other than those of the weights. A
    pose with larger standard deviations is refused as `imprecise`."""
    is_relative: bool = False
    """The position error of a right pose is at most 5 % of the distance of the seen points, however
    far these are. Always so in a map without scale."""
    min_inliers: Annotated[int, AtLeast(4)] = 5
    """Minimum number of inliers of a pose proposal. Proposals with fewer are not tested."""
    min_found: Annotated[int, AtLeast(4)] = 12
    """Minimum number of map points found at their predicted pixels."""
    min_probability: Annotated[float, Between(0, 1)] = 0.5
    """Minimum probability of a reported pose."""

    @property
    def max_errors(self) -> tuple[float, float]:
        """Return the maximum errors of a right pose, metres and degrees."""
        return self.tolerance or (self.max_translation, self.max_rotation_deg)


@dataclass(frozen=True)
class SimilarPlacesConfig:
    """Configure the separate search in similar places (perceptual aliasing)."""

    max_groups: Annotated[int | None, Between(0, 1000)] = None
    """Maximum number of similar places that are searched. 0 disables this step. Unset: the default
    of the feature type."""


@dataclass(frozen=True)
class NodeViewpointsConfig:
    """Configure node viewpoints as pose priors, used if no pose is clear."""

    num_nodes: Annotated[int | None, Between(0, 10_000)] = None
    """Number of best-ranked nodes that are compared one by one. 0 disables this step. Unset: 24, or
    0 for features without size and angle, for which the comparison is weak."""
    matching: GuidedConfig = field(default_factory=lambda: GuidedConfig(radius_px=64.0))
    """Guided matching around the pixels where the node saw its points."""


@dataclass(frozen=True)
class VirtualViewSearchConfig:
    """Configure the search in virtual views."""

    num_places: Annotated[int, Between(0, 10_000)] = 8
    """Number of places along the trajectory that are compared with both side views. 0 disables this
    step."""
    min_distance: ClassVar[float] = 5.0
    """Poses within this many D_thresh (Eq. 1) of a node are skipped, because that node would have
    found them."""
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    guided: GuidedConfig = field(default_factory=GuidedConfig)
    rounds: ClassVar[tuple[tuple[float, float], ...]] = (
        (0.0, 12.0),
        (0.0, 6.0),
        (30.0, 6.0),
        (25.0, 3.0),
        (25.0, 3.0),
    )
    """Search radius and maximum reprojection error of each round, pixels. Each round matches and
    fits in turn. Radius 0 uses the unguided matches, because guided ones bias an inaccurate
    pose."""


@dataclass(frozen=True, repr=False)
class LocalizerConfig(OneLine):
    """Configure the localizer. The features are those that the map was built with."""

    kinds: tuple[str, ...] | None = None
    """Feature types of the map to use, in order. Each next one is used if the pose is still unclear
    (None: all whose networks are installed)."""
    coarse: str | None = None
    """Name of the map's coarse localizer (None: the map's default)."""
    mask: str | None = None
    """Image file that is black where queries show what moves with the camera, such as the robot's
    own body, and white elsewhere. Of the queries' size, or scaled with it."""
    max_ms: Annotated[float | None, AtLeast(0)] = None
    """Time limit in milliseconds, after which no further hypothesis is tested (None: no limit)."""
    exactness: Literal["best", "fast"] = "best"
    """`best` refines the reported pose with more nodes, all feature types and aligned patches
    (`last_step.py`). `fast` leaves this out: the query takes about half as long."""
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
    num_clear_inliers: ClassVar[int] = 40
    """If the first pose has fewer inliers, its surroundings are searched twice."""
    num_chance_inliers: ClassVar[int] = 7
    """Number of inliers that can agree by chance. If the first matches give no more, and no
    viewpoint stands out, similar places are not searched."""
    min_matches: ClassVar[int] = 8
    """Minimum number of first matches for which a pose is estimated."""
    evidence: EvidenceConfig = field(default_factory=EvidenceConfig)
    look_alikes: SimilarPlacesConfig = field(default_factory=SimilarPlacesConfig)
    viewpoints: NodeViewpointsConfig = field(default_factory=NodeViewpointsConfig)
    max_repetitions: ClassVar[int] = 64
    """Maximum number of other poses that are tested in a repetitive place."""
    walls: VirtualViewSearchConfig = field(default_factory=VirtualViewSearchConfig)
    max_finer: ClassVar[float] = 1.15
    """An image is reduced to the focal length (pixels) of the map's finest camera if its own is
    larger by this factor. At larger sizes its key points match none of the map."""
    max_side_px: ClassVar[int] = 1600
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
