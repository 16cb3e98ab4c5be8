"""A pose sought in a part of the map, and whether it is believed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from topoloc.features.features import Features, Matches
from topoloc.features.matching import MatchingConfig, match_pooled
from topoloc.geometry.absolute_pose import AbsolutePose
from topoloc.geometry.camera import Camera
from topoloc.geometry.pose_covariance import covariance_of_inverse
from topoloc.geometry.rigid import Rigid3
from topoloc.geometry.rough_camera import RoughCamera
from topoloc.localization.guided import GuidedConfig, count_by_chance, visible_pixels
from topoloc.localization.local_map import LocalMap
from topoloc.localization.result import Localization, NotLocalized
from topoloc.localization.seen_points import SeenPoints
from topoloc.localization.shared_errors import inflation
from topoloc.localization.stages import StageClock
from topoloc.localization.verification import (
    Evidence,
    VerificationConfig,
    doubt_of,
    even_share_of,
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
    is_guided: bool = False
    """Were the matches sought where a pose expects them? Then they are no evidence for it."""

    @property
    def num_inliers(self) -> int:
        return int(self.pose.inliers.sum()) if self.pose else 0

    @property
    def node_id(self) -> int:
        """The node that most inliers come from; -1 without any."""
        if self.num_inliers == 0 or self.pose is None:
            return -1
        node_ids, counts = np.unique(self.local_map.node_ids[self.matches.train_idx[self.pose.inliers]], return_counts=True)
        return int(node_ids[counts.argmax()])

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
    matching: MatchingConfig,
    guided: GuidedConfig,
    config: VerificationConfig,
    clock: StageClock,
) -> Judgement:
    """A pose is an answer only where the evidence for it is strong.

    Evidence are matches that no pose guided. The first ones will do where they make the pose clear; where they do not, the nodes around
    the final pose are asked, which are often nearer than those that the coarse search named.

    Args:
        first: where a first pose comes from. `final`: what is found around that pose.
        shared_errors: rho of the map, see `shared_errors.py`.
    """
    num_matches = len(final.matches)
    if len(first.matches) < min_matches:
        return Judgement(NotLocalized("too_few_matches", candidates, len(first.matches), 0, clock.times_ms()), final)
    if first.pose is None or final.pose is None or first.num_inliers < config.min_inliers or final.num_inliers < config.min_found:
        return Judgement(NotLocalized("too_few_inliers", candidates, num_matches, final.num_inliers, clock.times_ms()), final)
    inflated = inflation(final.num_inliers, shared_errors)
    covariance = inflated * final.pose.covariance
    # points that share errors differ by them from node to node, so that even true matches agree with a pose less well
    agreement_px = config.agreement_px * math.sqrt(1.0 + shared_errors)
    evidence = None if first.is_guided else _evidence(first, final, covariance, agreement_px, guided, config)
    if evidence is None or log_odds_of(evidence, config) <= config.clear_log_odds:
        evidence = _evidence(_unguided(final, matching), final, covariance, agreement_px, guided, config)
    log_odds, probability = log_odds_of(evidence, config), probability_of(evidence, config)
    if probability < config.min_probability:
        reason, detail = "not_in_map", ""
        if is_only_imprecise(evidence, config):
            metres = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
            reason, detail = "too_few_inliers", f"in the map, but where is known to {metres:.2f} m only"
        refusal = NotLocalized(reason, candidates, num_matches, final.num_inliers, clock.times_ms(), detail)
        return Judgement(refusal, final, evidence, log_odds)
    answer = answer_of(final, covariance, 1.0 / inflated, probability, candidates, evidence, clock)
    return Judgement(answer, final, evidence, log_odds)


def answer_of(
    final: Attempt,
    covariance: Float[np.ndarray, "6 6"],
    noise_share: float,
    probability: float,
    candidates: list[NodeScore],
    evidence: Evidence,
    clock: StageClock,
) -> Localization:
    """The pose of `final` as a result. `covariance` is that of the left perturbation of cam_from_world."""
    assert final.pose is not None
    return Localization(
        world_from_cam=final.pose.cam_from_world.inverse(),
        covariance=covariance_of_inverse(final.pose.cam_from_world, covariance),
        probability=probability,
        node_id=final.node_id,
        candidates=candidates,
        num_matches=len(final.matches),
        num_inliers=final.num_inliers,
        times_ms=clock.times_ms(),
        evidence=evidence,
        focal_length_px=final.camera.fx if isinstance(final.lens, RoughCamera) else None,
        noise_share=noise_share,
    )


def _evidence(
    unguided: Attempt,
    final: Attempt,
    covariance: Float[np.ndarray, "6 6"],
    agreement_px: float,
    guided: GuidedConfig,
    config: VerificationConfig,
) -> Evidence:
    """`covariance` is that of the left perturbation of cam_from_world."""
    pose, camera = final.pose, final.camera
    assert pose is not None
    depths = pose.cam_from_world.apply(final.local_map.points_world[final.matches.train_idx[pose.inliers]])[:, 2]
    found_img = final.features.points_img[final.matches.query_idx[pose.inliers]].astype(np.float64)
    visible_img = visible_pixels(final.local_map, pose.cam_from_world, camera)
    return Evidence(
        num_matches=len(unguided.matches),
        num_inliers=_num_agreeing(unguided, pose.cam_from_world, camera, agreement_px),
        num_found=final.num_inliers,
        num_visible=len(visible_img),
        num_by_chance=count_by_chance(final.features, final.local_map, pose.cam_from_world, camera, guided),
        spread=spread_of(found_img, camera.width, camera.height),
        even_share=even_share_of(found_img, visible_img, camera.width, camera.height),
        doubt=doubt_of(covariance, float(np.median(depths)), config),
    )


def _unguided(final: Attempt, config: MatchingConfig) -> Attempt:
    """Matches with the points around the final pose that owe nothing to it."""
    local_map = final.local_map
    matches = match_pooled(final.features.descriptors, local_map.descriptors, local_map.points_world, local_map.radii, config)
    return replace(final, matches=matches, pose=None)


def _num_agreeing(unguided: Attempt, cam_from_world: Rigid3, camera: Camera, agreement_px: float) -> int:
    """How many of these matches agree with a pose that is not theirs."""
    points_cam = cam_from_world.apply(unguided.local_map.points_world[unguided.matches.train_idx])
    with np.errstate(invalid="ignore"):
        offsets = camera.img_from_cam(points_cam) - unguided.features.points_img[unguided.matches.query_idx]
        is_near = np.linalg.norm(offsets, axis=1) < agreement_px * max(max(camera.width, camera.height) / 640.0, 0.5)
    return int(np.count_nonzero(is_near))
