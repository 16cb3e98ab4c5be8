"""Localizing by the walls along the way: the last resort, for who comes back along a way that was mapped in one direction only.

The picture's views to the left and to the right (`features/side_views.py`) are compared with the map's side nodes that look most like
them; what their matches suggest (`side_hypotheses.py`) is followed up in both views together (`side_matching.py`), and believed on more
than the usual evidence. Walls repeat themselves, doors above all: so it also counts how many of the key points found look more like the
map's point here than like any that the side nodes show elsewhere, and the best pose must lead the next one. Where the map has nodes
that look the same way, they would have been recognised, so poses there are not considered.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Annotated

import numpy as np
from jaxtyping import Float, UInt8

from topoloc.bounds import Above, AtLeast, Between
from topoloc.errors import MapError
from topoloc.features.extraction import FeatureConfig, extract_features
from topoloc.features.matching import MatchingConfig, match_pooled
from topoloc.features.side_views import SideViewConfig, side_views
from topoloc.geometry.absolute_pose import AbsolutePose, AbsolutePoseConfig
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.attempt import Attempt, Judgement, answer_of
from topoloc.localization.guided import GuidedConfig, visible_pixels
from topoloc.localization.local_map import LocalMap
from topoloc.localization.shared_errors import inflation
from topoloc.localization.side_hypotheses import SideHypothesis, agreeing_pose
from topoloc.localization.side_matching import SeenSide, SideMatches, estimate_pose, match_sides, nearest_sides, of_picture
from topoloc.localization.side_verdict import SideVerdictConfig, side_log_odds
from topoloc.localization.stages import StageClock
from topoloc.localization.verification import Evidence, VerificationConfig, doubt_of, even_share_of, spread_of
from topoloc.localization.viewing import viewing_distances
from topoloc.map.nodes import NodePoses
from topoloc.map.topomap import SideNodes, TopoMetricMap, TopoNode
from topoloc.places.coarse import NodeScore
from topoloc.places.vlad import SurfVlad

_NODES_IN_MEMORY = 512


@dataclass(frozen=True)
class SidesConfig:
    """How the walls along the way are asked, and what is believed of them."""

    num_ranked: Annotated[int, Between(0, 10_000)] = 32
    """Side nodes that are compared with each view; 0 asks none."""
    num_hypotheses: Annotated[int, Between(0, 1000)] = 8
    """First poses of each view that are followed up."""
    num_nodes: Annotated[int, Between(1, 1000)] = 4
    """Side nodes whose points are sought in each view around a pose."""
    min_distance: Annotated[float, AtLeast(0)] = 5.0
    """Poses within so many D_thresh (Eq. 1) of a node would have been found by that node."""
    matching: MatchingConfig = field(default_factory=lambda: MatchingConfig(ratio=0.9))
    rounds: Annotated[tuple[tuple[float, float], ...], AtLeast(0)] = ((0.0, 12.0), (0.0, 6.0), (30.0, 6.0), (25.0, 3.0), (25.0, 3.0))
    """Matches and pose in turn: search radius and largest error, pixels. Radius 0 are the unguided matches: guided ones draw a pose that
    is not yet right towards itself."""
    sigma_px: Annotated[float, Above(0)] = 2.0
    """Standard deviation of a key point found at such a slant."""
    least_shared_errors: Annotated[float, Between(0, 1)] = 0.2
    """rho (`shared_errors.py`) is at least this: what is wrong with a wall seen at a slant is wrong with all points on it."""
    min_found: Annotated[int, AtLeast(4)] = 20
    """Points of a wall found where a pose says they must be, at least."""
    verdict: SideVerdictConfig = field(default_factory=SideVerdictConfig)


class SideLocalizer:
    """Asks a map's side nodes.

    Args:
        node_poses: of the map's ordinary nodes; `lambda_rot` and `d_thresh` (metres) are those of its Eq. 1.

    Raises:
        MapError: what ranks the side nodes is missing or not of them.
    """

    def __init__(
        self, topomap: TopoMetricMap, sides: SideNodes, node_poses: NodePoses, verification: VerificationConfig, config: SidesConfig
    ) -> None:
        self.config, self._verification, self._sides, self._node_poses = config, verification, sides, node_poses
        self._coarse, self._centres = _ranking_of(sides)
        self._axes = np.array([summary.world_from_cam.rotation[:, 2] for summary in sides.summaries])
        self._feature_config = FeatureConfig(**topomap.config["features"])
        self._view_config = SideViewConfig(**topomap.config["sides"]["views"])
        self._lambda_rot, self._d_thresh = (float(topomap.config["nodes"][name]) for name in ("lambda_rot", "d_thresh"))
        ids = {(summary.recording, summary.name): summary.node_id for summary in topomap.summaries}
        self._node_ids = [ids.get((summary.recording, summary.name), 0) for summary in sides.summaries]
        self._local_map = lru_cache(maxsize=_NODES_IN_MEMORY)(self._read)

    def localize(
        self, grey: UInt8[np.ndarray, "h w"], camera: Camera, candidates: list[NodeScore], shared_errors: float, clock: StageClock
    ) -> list[Judgement]:
        """Poses that the walls to both sides let expect, apart from each other, the best first, each as if it were believed.

        None where the lens is too narrow for walls, or nothing is recognised. `candidates` are passed on to the results.
        """
        seen, ranked = self._seen(grey, camera)
        judgements: list[Judgement] = []
        for hypothesis in self._hypotheses(seen, ranked):
            found = self._follow_up(hypothesis, seen, camera)
            if found is not None:
                judgements.append(self._judge(hypothesis, *found, camera, ranked, candidates, shared_errors, clock))
        judgements.sort(key=lambda judgement: -judgement.log_odds)
        distinct: list[Judgement] = []
        for judgement in judgements:
            if not any(self._agree(_pose(judgement), _pose(other)) for other in distinct):
                distinct.append(judgement)
        return distinct

    def _seen(self, grey: UInt8[np.ndarray, "h w"], camera: Camera) -> tuple[list[SeenSide], list[list[int]]]:
        """Both sides of the picture, and the side nodes that look most like each."""
        seen, ranked = [], []
        for view in side_views(camera, self._view_config):
            picture = view.picture(grey)
            features = view.within(extract_features(picture, self._feature_config))
            seen.append(SeenSide(view, features, view.in_picture(features, camera)))
            ranked.append([node.node_id for node in self._coarse.rank(picture, features, self.config.num_ranked)])
        return seen, ranked

    def _hypotheses(self, seen: list[SeenSide], ranked: list[list[int]]) -> list[SideHypothesis]:
        """The first poses that most matches of a view agree with, some for each view."""
        chosen: list[SideHypothesis] = []
        for view, (side, node_ids) in enumerate(zip(seen, ranked, strict=True)):
            of_view = [hypothesis for k in node_ids if (hypothesis := self._hypothesis(side, view, k)) is not None]
            of_view.sort(key=lambda hypothesis: -hypothesis.num_agreeing)
            kept: list[SideHypothesis] = []
            for hypothesis in of_view:
                if len(kept) < self.config.num_hypotheses and not any(
                    self._agree(hypothesis.cam_from_world, h.cam_from_world) for h in kept
                ):
                    kept.append(hypothesis)
            chosen += kept
        return chosen

    def _hypothesis(self, side: SeenSide, view: int, side_id: int) -> SideHypothesis | None:
        node, local_map = self._local_map(side_id)
        matches = match_pooled(
            side.features.descriptors, local_map.descriptors, local_map.points_world, local_map.radii, self.config.matching
        )
        agreeing = agreeing_pose(side.features, side.view.camera, node, matches)
        if agreeing is None or agreeing[0] < self._verification.min_inliers:
            return None
        num_agreeing, side_from_world = agreeing
        return SideHypothesis(side.view.cam_from_side @ side_from_world, view, side_id, matches, num_agreeing)

    def _follow_up(self, hypothesis: SideHypothesis, seen: list[SeenSide], camera: Camera) -> tuple[SideMatches, AbsolutePose] | None:
        """What both sides show around the first pose, and the pose that follows."""
        cam_from_world, found, pose = hypothesis.cam_from_world, None, None
        for k, (radius_px, max_error_px) in enumerate(self.config.rounds, start=1):
            if self._is_mapped(cam_from_world):
                return None
            found = self._matched(hypothesis, seen, cam_from_world, radius_px, with_counts=k == len(self.config.rounds))
            pose = self._estimate(found, camera, cam_from_world, max_error_px) if found is not None else None
            if pose is None or np.count_nonzero(pose.inliers) < self._verification.min_inliers:
                return None
            cam_from_world = pose.cam_from_world
        if found is None or pose is None or np.count_nonzero(pose.inliers) < self.config.min_found or self._is_mapped(cam_from_world):
            return None
        return found, pose

    def _judge(
        self,
        hypothesis: SideHypothesis,
        found: SideMatches,
        pose: AbsolutePose,
        camera: Camera,
        ranked: list[list[int]],
        candidates: list[NodeScore],
        shared_errors: float,
        clock: StageClock,
    ) -> Judgement:
        attempt = Attempt(found.features, camera, camera, found.local_map, found.matches, pose)
        inflated = inflation(attempt.num_inliers, max(shared_errors, self.config.least_shared_errors))
        evidence = self._evidence(hypothesis, attempt, found, inflated * pose.covariance)
        log_odds = side_log_odds(evidence, self._num_distinct(attempt, ranked), self.config.verdict)
        probability = 1.0 / (1.0 + math.exp(-log_odds))
        answer = answer_of(attempt, inflated * pose.covariance, 1.0 / inflated, probability, candidates, evidence, clock)
        return Judgement(answer, attempt, evidence, log_odds)

    def _matched(
        self, hypothesis: SideHypothesis, seen: list[SeenSide], cam_from_world: Rigid3, radius_px: float, with_counts: bool
    ) -> SideMatches | None:
        """The matches of the hypothesis itself, or, with a radius, those of both sides around the pose."""
        if radius_px == 0.0:
            return SideMatches(seen[hypothesis.view].in_picture, self._local_map(hypothesis.side_id)[1], hypothesis.matches, 0, 0)
        sides = [(side, local_map) for side in seen if (local_map := self._around(side, cam_from_world)) is not None]
        return match_sides(sides, cam_from_world, GuidedConfig(radius_px=radius_px), with_counts)

    def _estimate(self, found: SideMatches, camera: Camera, near: Rigid3, max_error_px: float) -> AbsolutePose | None:
        """The pose refined, or sought anew where that has more inliers and is near: a wall has a second pose."""
        config = AbsolutePoseConfig(max_reprojection_error_px=max_error_px, sigma_px=self.config.sigma_px, max_iterations=1000)
        refined, anew = estimate_pose(found, camera, config, near), estimate_pose(found, camera, config, None)
        if anew is None or not self._agree(anew.cam_from_world, near):
            return refined
        return anew if refined is None or np.count_nonzero(anew.inliers) > np.count_nonzero(refined.inliers) else refined

    def _evidence(self, hypothesis: SideHypothesis, attempt: Attempt, found: SideMatches, covariance: Float[np.ndarray, "6 6"]) -> Evidence:
        assert attempt.pose is not None
        camera, inliers = attempt.camera, attempt.pose.inliers
        depths = attempt.pose.cam_from_world.apply(found.local_map.points_world[found.matches.train_idx[inliers]])[:, 2]
        points_img = found.features.points_img[found.matches.query_idx[inliers]].astype(np.float64)
        visible_img = visible_pixels(found.local_map, attempt.pose.cam_from_world, camera)
        return Evidence(
            num_matches=len(hypothesis.matches),
            num_inliers=hypothesis.num_agreeing,
            num_found=attempt.num_inliers,
            num_visible=found.num_visible,
            num_by_chance=found.num_by_chance,
            spread=spread_of(points_img, camera.width, camera.height),
            doubt=doubt_of(covariance, float(np.median(depths)), self._verification),
            even_share=even_share_of(points_img, visible_img, camera.width, camera.height),
        )

    def _num_distinct(self, attempt: Attempt, ranked: list[list[int]]) -> int:
        """How many inliers look more like the map's point here than like any point that the ranked side nodes show elsewhere."""
        assert attempt.pose is not None
        rows, columns = (index[attempt.pose.inliers] for index in (attempt.matches.query_idx, attempt.matches.train_idx))
        descriptors, points_world = attempt.features.descriptors[rows], attempt.local_map.points_world[columns]
        here = np.sum(descriptors * attempt.local_map.descriptors[columns], axis=1)
        away = 1.5 * self.config.min_distance * self._d_thresh
        centre = points_world.mean(axis=0)
        for side_id in sorted({k for of_view in ranked for k in of_view}):
            _, other = self._local_map(side_id)
            is_far = np.linalg.norm(other.points_world - centre, axis=1) > away
            if is_far.any():
                here = np.where((descriptors @ other.descriptors[is_far].T).max(axis=1) >= here, np.inf, here)
        return int(np.count_nonzero(np.isfinite(here)))

    def _around(self, side: SeenSide, cam_from_world: Rigid3) -> LocalMap | None:
        side_ids = nearest_sides(side.view, cam_from_world, self._centres, self._axes, self.config.num_nodes)
        return LocalMap.pooled([self._local_map(k)[1] for k in side_ids]) if side_ids and len(side.features) else None

    def _is_mapped(self, cam_from_world: Rigid3) -> bool:
        """Do nodes of the map look this way from here?"""
        distances = viewing_distances(cam_from_world.inverse(), self._node_poses, self._lambda_rot)
        return bool(distances.min() < self.config.min_distance * self._d_thresh)

    def _agree(self, a_from_world: Rigid3, b_from_world: Rigid3) -> bool:
        apart = a_from_world @ b_from_world.inverse()
        way = float(np.linalg.norm(a_from_world.inverse().translation - b_from_world.inverse().translation))
        return way < 1.5 * self._d_thresh and apart.angle() < math.radians(20.0)

    def _read(self, side_id: int) -> tuple[TopoNode, LocalMap]:
        node = self._sides.nodes[side_id]
        return node, of_picture(LocalMap.of_node(node), self._node_ids[side_id])


def _ranking_of(sides: SideNodes) -> tuple[SurfVlad, Float[np.ndarray, "nodes 3"]]:
    """What names the side nodes that look most like a view, and the middles (metres, world) of what they show."""
    models = list(sides.coarse_models.values())
    centres = models[0].arrays.get("centres") if len(models) == 1 else None
    if centres is None or centres.shape != (len(sides.summaries), 3):
        raise MapError("the map's side nodes come without what ranks them; build it again")
    return SurfVlad.from_model(models[0]), centres


def _pose(judgement: Judgement) -> Rigid3:
    assert judgement.final.pose is not None
    return judgement.final.pose.cam_from_world
