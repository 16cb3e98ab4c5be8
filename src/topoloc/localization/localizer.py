"""Localizing a single image in the topo-metric map: section III-B of the paper, read from the top.

The coarse localizer names the nodes that the image may belong to; the image is patch-normalised and its features are
matched with those of the nodes; PnP on the matches gives the camera's global pose. Unlike the paper's blind first choice,
several candidate nodes pool their points; the nodes nearest to the pose so found, whose points are sought where they must
be seen, make it exact; and it is reported only where the evidence is strong and no other part of the map explains the image as
well. Where nothing is clear, the walls along the way are asked from the other side. One candidate, no guided step, no rivals and no walls
(`num_candidates=1`, `guided.num_nodes=0`, `rivals.max_groups=0`, `sides.num_ranked=0`) give the paper's own behaviour.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Annotated

import numpy as np

from topoloc.bounds import Above, AtLeast, Between, check_bounds
from topoloc.errors import EmptyMapError, QueryError
from topoloc.features.extraction import FeatureConfig, extract_normalized, normalize_image
from topoloc.features.features import Features, Matches
from topoloc.features.matching import MatchingConfig, match_pooled
from topoloc.geometry.absolute_pose import AbsolutePoseConfig, estimate_absolute_pose
from topoloc.geometry.absolute_pose_focal import estimate_pose_and_focal
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.geometry.rough_camera import RoughCamera, usual_camera
from topoloc.localization.attempt import Attempt, Judgement, judge
from topoloc.localization.guided import GuidedConfig, match_guided
from topoloc.localization.local_map import LocalMap
from topoloc.localization.query_size import reduced_query
from topoloc.localization.result import Localization, NotLocalized
from topoloc.localization.rivals import RivalsConfig, decide, rival_groups
from topoloc.localization.seen_points import SeenPoints
from topoloc.localization.shared_errors import SharedErrorsConfig, shared_errors_of
from topoloc.localization.side_localizer import SideLocalizer, SidesConfig
from topoloc.localization.side_verdict import decide_with_sides
from topoloc.localization.stages import StageClock
from topoloc.localization.standpoints import StandpointsConfig, strongest_and_distinct
from topoloc.localization.verification import VerificationConfig
from topoloc.localization.viewing import viewing_distances
from topoloc.map.nodes import NodePoses
from topoloc.map.topomap import TopoMetricMap, open_coarse_of
from topoloc.places.coarse import CoarseLocalizer, Image, NodeScore
from topoloc.sequences.pictures import grey_image

NODES_IN_MEMORY = 256


@dataclass(frozen=True)
class LocalizerConfig:
    """How a query is answered. The features are those that the map was built with."""

    coarse: str | None = None
    """Which of the map's coarse localizers is asked (None: the map's default)."""
    num_candidates: Annotated[int, Between(1, 1000)] = 4
    """Nodes whose points are pooled; 1 is the paper's single node."""
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    guided: GuidedConfig = field(default_factory=GuidedConfig)
    pose: AbsolutePoseConfig = field(default_factory=lambda: AbsolutePoseConfig(max_reprojection_error_px=8.0))
    num_first_features: Annotated[int, AtLeast(1)] = 500
    """The image's strongest features are matched first; the rest only where these give fewer inliers than the next number."""
    num_clear_inliers: Annotated[int, AtLeast(0)] = 40
    """Inliers from which on the first matches are enough."""
    min_matches: Annotated[int, AtLeast(0)] = 8
    """With fewer first matches no pose is sought."""
    verification: VerificationConfig = field(default_factory=VerificationConfig)
    rivals: RivalsConfig = field(default_factory=RivalsConfig)
    standpoints: StandpointsConfig = field(default_factory=StandpointsConfig)
    sides: SidesConfig = field(default_factory=SidesConfig)
    shared_errors: SharedErrorsConfig = field(default_factory=SharedErrorsConfig)
    max_finer: Annotated[float, Above(0)] = 1.15
    """An image of more than so many times the pixels a radian (focal length in pixels) of the map's finest camera is reduced to that
    camera's first: at larger sizes its key points find none alike in the map."""
    max_side_px: Annotated[int, Between(64, 16_384)] = 1600
    """Larger images are reduced to this width or height first: nothing is gained from more, but time and memory."""


class Localizer:
    """Holds an open map, its coarse localizer and the nodes used lately.

    Args:
        coarse: names the candidate nodes instead of one of the map's own coarse localizers: any object with `CoarseLocalizer.rank`
            (`topoloc/places/coarse.py`), such as retrieval of another kind or a prior from elsewhere. `config.coarse` is then left aside.

    Raises:
        ConfigError: a value of `config` is out of its bounds.
        EmptyMapError: the map has no node.
        MapError: the map has no such coarse localizer.
    """

    def __init__(self, topomap: TopoMetricMap, config: LocalizerConfig | None = None, coarse: CoarseLocalizer | None = None) -> None:
        self.config = config or LocalizerConfig()
        check_bounds(self.config)
        self.topomap = topomap
        if len(topomap.summaries) == 0:
            raise EmptyMapError("the map has no nodes")
        self._coarse = open_coarse_of(topomap, self.config.coarse or topomap.default_coarse) if coarse is None else coarse
        self._feature_config = FeatureConfig(**topomap.config["features"])
        self._node_poses = NodePoses.of([summary.world_from_cam for summary in topomap.summaries])
        self._lambda_rot = float(topomap.config["nodes"]["lambda_rot"])
        self._d_thresh = float(topomap.config["nodes"]["d_thresh"])
        self._local_map = lru_cache(maxsize=NODES_IN_MEMORY)(lambda node_id: LocalMap.of_node(topomap.nodes[node_id]))

    def localize(self, image: Image, camera: Camera | RoughCamera | None) -> Localization | NotLocalized:
        """Where was this image (grey or RGB, uint8) taken, by a camera of this calibration?

        Of a camera that is only roughly known, or not at all (None), the focal length is found with the pose; that takes a few times as
        long, and it is taken for a pinhole.

        Raises:
            QueryError: the camera is of another image size.
        """
        height, width = image.shape[:2]
        return self.localize_near(image, RoughCamera.unknown(width, height) if camera is None else camera, None)[0]

    def localize_near(
        self, image: Image, camera: Camera | RoughCamera, near: Rigid3 | None
    ) -> tuple[Localization | NotLocalized, SeenPoints | None]:
        """As `localize`, where the camera is known to be about `near` (world_from_cam): the nodes nearest to it replace the coarse search.

        None for `near` is `localize` itself. Only the choice of nodes is taken from `near`: the pose needs the same evidence as any
        other, of matches that it did not guide. Also returned are the points that the pose stands on, in pixels of `image`.

        Raises:
            QueryError: the camera is of another image size.
        """
        height, width = image.shape[:2]
        if (camera.width, camera.height) != (width, height):
            raise QueryError(f"the image is {width}x{height}, its camera {camera.width}x{camera.height}")
        shared_errors, map_focal = self.shared_errors, self._map_focal  # of the first query alone; the map's time, not the query's
        clock = StageClock()
        image, lens = reduced_query(image, camera, map_focal, self.config.max_finer, self.config.max_side_px)
        scale = width / lens.width
        features = self._extract(image, clock)
        if near is not None:
            expecting = self._localize_among(self._nodes_near(near), features, lens, clock)
            judgement = self._judge(expecting, [], shared_errors, clock)
        else:
            ranked = self._rank_nodes(image, features, clock)
            candidates = ranked[: self.config.num_candidates]
            first = self._localize_among(candidates, features, lens, clock)
            judgement = self._judge(first, candidates, shared_errors, clock)
            judgement = self._against_rivals(judgement, ranked, features, lens, shared_errors, clock)
            judgement = self._against_sides(judgement, image, lens, shared_errors, clock)
        result = judgement.result
        if not isinstance(result, Localization):
            return result, None
        if result.focal_length_px is not None:
            result = replace(result, focal_length_px=result.focal_length_px * scale)
        return result, judgement.final.seen_points(scale)

    @cached_property
    def shared_errors(self) -> float:
        """rho of the map: the share of a match's variance that its points have in common (see `shared_errors.py`)."""
        return shared_errors_of(self.topomap, self.config.guided, self.config.pose, self.config.shared_errors)

    @cached_property
    def _sides(self) -> SideLocalizer | None:
        if self.topomap.sides is None or self.config.sides.num_ranked == 0:
            return None
        return SideLocalizer(self.topomap, self.topomap.sides, self._node_poses, self.config.verification, self.config.sides)

    @cached_property
    def _map_focal(self) -> float:
        """Focal length (pixels) of the finest camera that mapped; each recording is taken to have one camera."""
        first_nodes = {summary.recording: summary.node_id for summary in reversed(self.topomap.summaries)}
        return max(self.topomap.nodes[node_id].camera.fx for node_id in first_nodes.values())

    def _extract(self, image: Image, clock: StageClock) -> Features:
        """Patch normalisation, then the local features."""
        grey = grey_image(image)
        with clock.stage("patch_normalization"):
            normalized = normalize_image(grey, self._feature_config)
        with clock.stage("features"):
            return extract_normalized(normalized, self._feature_config)

    def _rank_nodes(self, image: Image, features: Features, clock: StageClock) -> list[NodeScore]:
        """The coarse step: which nodes may this be?"""
        with clock.stage("coarse"):
            return self._coarse.rank(image, features, max(self.config.num_candidates, self.config.rivals.num_ranked))

    def _localize_among(self, candidates: list[NodeScore], features: Features, lens: Camera | RoughCamera, clock: StageClock) -> Attempt:
        """The candidates' points together. The strongest features are nearly always enough; all are tried where they are not."""
        local_map = self._pooled([candidate.node_id for candidate in candidates])
        attempt = self._localize_in(local_map, features, lens, clock, self.config.num_first_features)
        if attempt.num_inliers < self.config.num_clear_inliers and len(features) > self.config.num_first_features:
            attempt = self._localize_in(local_map, features, lens, clock)
        return attempt

    def _nodes_near(self, world_from_cam: Rigid3) -> list[NodeScore]:
        """As many nodes as the coarse step would name; nearer ones (Eq. 1) score higher."""
        distances = viewing_distances(world_from_cam, self._node_poses, self._lambda_rot)
        nearest = np.argsort(distances, kind="stable")[: self.config.num_candidates]
        return [NodeScore(int(i), -float(distances[i])) for i in nearest]

    def _localize_in(
        self, local_map: LocalMap, features: Features, lens: Camera | RoughCamera, clock: StageClock, max_features: int | None = None
    ) -> Attempt:
        """The fine step: match with the candidates' points, then robust PnP."""
        with clock.stage("matching"):
            descriptors = features.descriptors[:max_features]
            matches = match_pooled(descriptors, local_map.descriptors, local_map.points_world, local_map.radii, self.config.matching)
        return self._attempt(features, lens, local_map, matches, None, clock)

    def _localize_around(self, first: Attempt, clock: StageClock) -> Attempt:
        """Once more with the nodes nearest to the pose found, each point sought where it must be seen."""
        if self.config.guided.num_nodes == 0 or first.pose is None or first.num_inliers < self.config.verification.min_inliers:
            return first
        with clock.stage("matching"):
            cam_from_world = first.pose.cam_from_world
            distances = viewing_distances(cam_from_world.inverse(), self._node_poses, self._lambda_rot)
            nearest = np.argsort(distances, kind="stable")[: self.config.guided.num_nodes]
            local_map = self._pooled([int(i) for i in nearest])
            matches = match_guided(first.features, local_map, cam_from_world, first.camera, self.config.guided)
        return self._attempt(first.features, first.lens, local_map, matches, (cam_from_world, first.camera), clock)

    def _attempt(
        self,
        features: Features,
        lens: Camera | RoughCamera,
        local_map: LocalMap,
        matches: Matches,
        start: tuple[Rigid3, Camera] | None,
        clock: StageClock,
        config: AbsolutePoseConfig | None = None,
    ) -> Attempt:
        """Robust PnP, or the refinement of `start` (cam_from_world and the camera); with the focal length, of a rough camera."""
        camera = start[1] if start else usual_camera(lens)
        if start is None and len(matches) < self.config.min_matches:
            return Attempt(features, lens, camera, local_map, matches, None)
        points_img = features.points_img[matches.query_idx].astype(np.float64)
        points_world, covariances = local_map.points_world[matches.train_idx], local_map.covariances[matches.train_idx]
        config = config or self.config.pose
        with clock.stage("pnp"):
            if isinstance(lens, RoughCamera):
                found = estimate_pose_and_focal(points_img, points_world, lens, config, point_covariances=covariances, start=start)
                pose, camera = found or (None, camera)
            else:
                near = start[0] if start else None
                pose = estimate_absolute_pose(points_img, points_world, lens, config, point_covariances=covariances, start=near)
        return Attempt(features, lens, camera, local_map, matches, pose)

    def _judge(self, first: Attempt, candidates: list[NodeScore], shared_errors: float, clock: StageClock) -> Judgement:
        """What is found around the first pose, and whether it is believed."""
        final = self._localize_around(first, clock)
        if first.num_inliers < self.config.num_clear_inliers:  # it may have been too poor to be found from all at once
            final = max(final, self._localize_around(final, clock), key=lambda attempt: attempt.num_inliers)
        with clock.stage("verification"):
            c = self.config
            return judge(first, final, candidates, shared_errors, c.min_matches, c.matching, c.guided, c.verification, clock)

    def _against_rivals(
        self,
        judgement: Judgement,
        ranked: list[NodeScore],
        features: Features,
        lens: Camera | RoughCamera,
        shared_errors: float,
        clock: StageClock,
    ) -> Judgement:
        """Other parts of the map that look like the image are asked on their own."""
        result, config = judgement.result, self.config.rivals
        found = result.world_from_cam if isinstance(result, Localization) else None
        asked = [candidate.node_id for candidate in result.candidates]
        is_clear = judgement.log_odds > self.config.verification.clear_log_odds
        groups = rival_groups(
            ranked, asked, found, is_clear, self._node_poses, self._lambda_rot, self._d_thresh, self.config.num_candidates, config
        )
        judgements = [judgement]
        for group in groups:
            first = self._localize_in(self._pooled(group), features, lens, clock)
            judgements.append(self._judge(first, result.candidates, shared_errors, clock))
        if not is_clear and config.max_groups > 0:
            attempts = self._from_nodes(ranked, features, lens, clock)
            judgements += [self._judge(first, result.candidates, shared_errors, clock) for first in attempts]
        return decide(judgements, self._lambda_rot, self._d_thresh, config, clock) if len(judgements) > 1 else judgement

    def _against_sides(
        self, judgement: Judgement, image: Image, lens: Camera | RoughCamera, shared_errors: float, clock: StageClock
    ) -> Judgement:
        """Where no pose is clear, the walls to both sides are asked: they may be seen from the other side."""
        config = self.config.sides
        is_clear = isinstance(judgement.result, Localization) and judgement.log_odds > config.verdict.rival_log_odds
        if is_clear or isinstance(lens, RoughCamera) or self._sides is None:  # the last opens the side nodes
            return judgement
        with clock.stage("sides"):
            sides = self._sides.localize(grey_image(image), lens, judgement.result.candidates, shared_errors, clock)
        return decide_with_sides(judgement, sides, config.verdict, clock)

    def _from_nodes(self, ranked: list[NodeScore], features: Features, lens: Camera | RoughCamera, clock: StageClock) -> list[Attempt]:
        """First poses of what the nodes saw, see `standpoints.py`."""
        config, attempts = self.config.standpoints, []
        quick = replace(self.config.pose, max_iterations=config.max_iterations)
        for candidate in ranked[: config.num_nodes]:
            local_map, world_from_node = self._pooled([candidate.node_id]), self.topomap.summaries[candidate.node_id].world_from_cam
            with clock.stage("matching"):
                matches = match_guided(features, local_map, world_from_node.inverse(), usual_camera(lens), config.matching)
            attempts.append(replace(self._attempt(features, lens, local_map, matches, None, clock, quick), is_guided=True))
        reach = self.config.rivals.agreement * self._d_thresh
        return strongest_and_distinct(attempts, self._lambda_rot, reach, config.max_poses)

    def _pooled(self, node_ids: list[int]) -> LocalMap:
        return LocalMap.pooled([self._local_map(node_id) for node_id in node_ids])
