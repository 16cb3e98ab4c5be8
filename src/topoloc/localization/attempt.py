"""A pose sought in a part of the map, and whether it is believed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from topoloc.features.features import Features, Matches
from topoloc.geometry.absolute_pose import AbsolutePose
from topoloc.geometry.camera import Camera
from topoloc.geometry.pose_covariance import covariance_of_inverse
from topoloc.geometry.rough_camera import RoughCamera
from topoloc.localization.guided import GuidedConfig, count_by_chance, count_visible
from topoloc.localization.local_map import LocalMap
from topoloc.localization.result import Localization, NotLocalized
from topoloc.localization.seen_points import SeenPoints
from topoloc.localization.shared_errors import inflation
from topoloc.localization.stages import StageClock
from topoloc.localization.verification import (
    Evidence,
    VerificationConfig,
    doubt_of,
    is_only_imprecise,
    log_odds_of,
    probability_of,
    spread_of,
)
from topoloc.places.coarse import NodeScore


@dataclass(frozen=True, eq=False)
class Attempt:
    """Matches of the features with a part of the map, and the pose that most of them agree on.

    `lens` is what is known of the camera, `camera` the same, or, of a rough one, what comes of it with the focal length found.
    """

    features: Features
    lens: Camera | RoughCamera
    camera: Camera
    local_map: LocalMap
    matches: Matches
    pose: AbsolutePose | None

    @property
    def num_inliers(self) -> int:
        return int(self.pose.inliers.sum()) if self.pose else 0

    @property
    def node_id(self) -> int:
        """The node that most inliers come from; -1 without any."""
        if self.num_inliers == 0 or self.pose is None:
            return -1
        return int(np.bincount(self.local_map.node_ids[self.matches.train_idx[self.pose.inliers]]).argmax())

    def seen_points(self, scale: float) -> SeenPoints | None:
        """The inliers in a picture that is `scale` times as wide as that of the features; None without a pose."""
        if self.pose is None:
            return None
        query_idx, train_idx = self.matches.query_idx[self.pose.inliers], self.matches.train_idx[self.pose.inliers]
        points_world, covariances = self.local_map.points_world[train_idx], self.local_map.covariances[train_idx]
        return SeenPoints(self.features.points_img[query_idx], points_world, covariances).in_image(scale)


@dataclass(frozen=True, eq=False)
class Judgement:
    """What is answered, with the evidence for `final`'s pose (None where there is none) and the logarithm of the odds that it is right."""

    result: Localization | NotLocalized
    final: Attempt
    evidence: Evidence | None = None
    log_odds: float = float("-inf")


def judge(
    first: Attempt,
    final: Attempt,
    candidates: list[NodeScore],
    shared_errors: float,
    min_matches: int,
    guided: GuidedConfig,
    config: VerificationConfig,
    clock: StageClock,
) -> Judgement:
    """A pose is an answer only where the evidence for it is strong.

    Args:
        first: what most of the features say, unguided. `final`: what is found around that pose.
        shared_errors: rho of the map, see `shared_errors.py`.
    """
    num_matches = len(final.matches)
    if len(first.matches) < min_matches:
        return Judgement(NotLocalized("too_few_matches", candidates, len(first.matches), 0, clock.times_ms()), final)
    if first.pose is None or final.pose is None or first.num_inliers < config.min_inliers or final.num_inliers < config.min_found:
        return Judgement(NotLocalized("too_few_inliers", candidates, num_matches, final.num_inliers, clock.times_ms()), final)
    inflated = inflation(final.num_inliers, shared_errors)
    covariance = inflated * final.pose.covariance
    evidence = _evidence(first, final, covariance, guided, config)
    log_odds, probability = log_odds_of(evidence, config), probability_of(evidence, config)
    if probability < config.min_probability:
        reason, detail = "not_in_map", ""
        if is_only_imprecise(evidence, config):
            metres = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
            reason, detail = "too_few_inliers", f"in the map, but where is known to {metres:.2f} m only"
        refusal = NotLocalized(reason, candidates, num_matches, final.num_inliers, clock.times_ms(), detail)
        return Judgement(refusal, final, evidence, log_odds)
    answer = Localization(
        world_from_cam=final.pose.cam_from_world.inverse(),
        covariance=covariance_of_inverse(final.pose.cam_from_world, covariance),
        probability=probability,
        node_id=final.node_id,
        candidates=candidates,
        num_matches=num_matches,
        num_inliers=final.num_inliers,
        times_ms=clock.times_ms(),
        evidence=evidence,
        focal_length_px=final.camera.fx if isinstance(final.lens, RoughCamera) else None,
        noise_share=1.0 / inflated,
    )
    return Judgement(answer, final, evidence, log_odds)


def _evidence(
    first: Attempt, final: Attempt, covariance: Float[np.ndarray, "6 6"], guided: GuidedConfig, config: VerificationConfig
) -> Evidence:
    """`covariance` is that of the left perturbation of cam_from_world."""
    pose, camera = final.pose, final.camera
    assert pose is not None
    depths = pose.cam_from_world.apply(final.local_map.points_world[final.matches.train_idx[pose.inliers]])[:, 2]
    return Evidence(
        num_matches=len(first.matches),
        num_inliers=first.num_inliers,
        num_found=final.num_inliers,
        num_visible=count_visible(final.local_map, pose.cam_from_world, camera),
        num_by_chance=count_by_chance(final.features, final.local_map, pose.cam_from_world, camera, guided),
        spread=spread_of(final.features.points_img[final.matches.query_idx[pose.inliers]].astype(np.float64), camera.width, camera.height),
        doubt=doubt_of(covariance, float(np.median(depths)), config),
    )
