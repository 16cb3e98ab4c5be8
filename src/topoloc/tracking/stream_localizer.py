"""Localize an image of a stream in full, and weigh the result against the pose hypotheses."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from topoloc.geometry.rigid import Rigid3
from topoloc.localization.exact.appearance import share_of_this_floor
from topoloc.localization.localizer import Localizer
from topoloc.localization.pose_fit import PointObservations
from topoloc.localization.query import QueryImage
from topoloc.localization.result import Localization, NotLocalized
from topoloc.tracking.motion import is_same_place
from topoloc.tracking.pose_hypotheses import Candidate, PoseHypotheses
from topoloc.tracking.tracker_state import PoseErrors, StreamFrame, compute_pose_errors

_NOTHING_SEEN = ("too_few_matches", "too_few_inliers")


@dataclass(frozen=True, eq=False)
class ExpectedPose:
    """Hold the expected pose of an image.

    `pose_covariance` is the error that the filter does not include (left perturbation of
    cam_from_world). A search around the expected pose finds only that place. `is_unique` is True if
    no other place is likely. `is_tracked` is True if the pose comes from tracked points.
    `is_refutable` is False if nearby nodes have another viewing direction, so they cannot confirm
    or reject the image.
    """

    world_from_cam: Rigid3
    pose_covariance: Float[np.ndarray, "6 6"]
    is_unique: bool
    is_tracked: bool = False
    is_refutable: bool = True


@dataclass(frozen=True, eq=False)
class LocalizedPose:
    """Hold a possible pose of the image with its inliers, errors and probability."""

    result: Localization
    inlier_points: PointObservations
    errors: PoseErrors
    probability: float

    def as_candidate(self, more: Float[np.ndarray, "6 6"]) -> Candidate:
        """Return the pose for the hypotheses, with more covariance."""
        pose, node_id = self.result.world_from_cam, self.result.node_id
        return Candidate(pose, self.errors.total + more, self.probability, node_id)


class StreamLocalizer:
    """Run the localizer and update the hypotheses with its result."""

    def __init__(self, localizer: Localizer, hypotheses: PoseHypotheses) -> None:
        self._localizer, self._hypotheses = localizer, hypotheses
        self._has_look_alikes = localizer.topomap.config.look_alike_floors
        self._last_ambiguous_pose: Rigid3 | None = None  # pose of the last ambiguous image
        self._has_prior = hypotheses.best is not None

    def localize(
        self, frame: StreamFrame, expected: ExpectedPose | None
    ) -> LocalizedPose | NotLocalized:
        """Localize an image around the expected pose first, then in the whole map.

        Return the pose of the best hypothesis, or the reason if there is none.
        """
        best = self._hypotheses.best
        if expected is None and self._has_prior and best is not None:
            expected = ExpectedPose(best.world_from_cam, np.zeros((6, 6)), is_unique=True)
        pose_covariance = np.zeros((6, 6)) if expected is None else expected.pose_covariance
        refusal, found = None, list[LocalizedPose]()
        if expected is not None and expected.is_unique:
            refusal, found = self._query_localizer(frame, expected.world_from_cam)
            if refusal is not None and expected.is_tracked:
                if expected.is_refutable:
                    self._hypotheses.update_weights(frame.t_ns, [])
                return refusal
        candidates = [localized.as_candidate(pose_covariance) for localized in found]
        if len(candidates) != 1 or not self._hypotheses.is_expected(candidates[0]):
            refusal, found = self._localize_globally(frame)
            candidates = [localized.as_candidate(pose_covariance) for localized in found]
        is_bridged = self._hypotheses.is_turn_measured and not found
        if refusal is not None and is_bridged and refusal.reason in _NOTHING_SEEN:
            return refusal  # a dark image is no evidence, and the rotation through it is known
        self._hypotheses.update_weights(
            frame.t_ns, candidates, frame.odom_from_cam, self._compute_new_evidence(found)
        )
        if self._hypotheses.candidate_idx is not None:
            self._has_prior = False
            return found[self._hypotheses.candidate_idx]
        return refusal or reject_jump(found[0].result)

    def _compute_new_evidence(self, found: list[LocalizedPose]) -> float:
        """Return the share of new evidence in an uncertain result since the last uncertain one."""
        # Motion after which the evidence of alternatives is new except for 1/e. It is the
        # distance in depths of the points, plus the rotation in radians.
        renewal = 1.0
        # The same motion for a single pose that is less certain than a localization can
        # be.
        renewal_alone = 0.1
        best, before = self._hypotheses.best, self._last_ambiguous_pose
        if not found or best is None or found[0].probability >= 1.0 - self._hypotheses.miss:
            return 1.0
        self._last_ambiguous_pose = best.world_from_cam
        if before is None or not self._hypotheses.is_track_continued:
            return 1.0
        moved = before.inverse() @ best.world_from_cam
        depth = float(np.median([localized.errors.depth for localized in found]))
        way = float(np.linalg.norm(moved.translation)) / depth + moved.angle()
        return 1.0 - math.exp(-way / (renewal if len(found) > 1 else renewal_alone))

    def _localize_globally(
        self, frame: StreamFrame
    ) -> tuple[NotLocalized | None, list[LocalizedPose]]:
        """Localize an image in the whole map.

        If the result is not unique, the image is also localized around each hypothesis missing from
        it. A search returns only some of many similar poses. A missing pose is at most as likely as
        the average of the others.
        """
        # Number of hypotheses around which an image is localized again if its result
        # omits them.
        max_queries = 8
        refusal, found = self._query_localizer(frame, None)
        if refusal is None:
            return refusal, found
        known = list(found)
        for hypothesis in self._hypotheses.alternatives()[:max_queries]:
            if not _is_known_pose(hypothesis.world_from_cam, known):
                around = self._query_localizer(frame, hypothesis.world_from_cam)[1]
                known += [
                    localized
                    for localized in around
                    if not _is_known_pose(localized.result.world_from_cam, known)
                ]
        shares = [len(found) if k < len(found) else 1 for k in range(len(known))]
        return refusal, [
            replace(localized, probability=localized.probability * share / len(known))
            for localized, share in zip(known, shares, strict=True)
        ]

    def _query_localizer(
        self, frame: StreamFrame, near: Rigid3 | None
    ) -> tuple[NotLocalized | None, list[LocalizedPose]]:
        """Return the possible poses of the image: one, the alternatives, or none with the
        reason."""
        result, named = self._localizer.localize_query(
            QueryImage(frame.image, frame.camera), near, frame.limit
        )
        refusal, found = result if isinstance(result, NotLocalized) else None, list[LocalizedPose]()
        for localization, points in named:
            probability = localization.probability
            if refusal is None:
                share = share_of_this_floor(localization.appearance, self._has_look_alikes)
                # The stream judges the floor.
                place = _place_probability(localization) / max(share, 1e-9)
                probability = min(place, 1.0 - self._hypotheses.miss)
            depths = localization.world_from_cam.inverse().apply(points.points_world)[:, 2]
            errors = compute_pose_errors(localization, float(np.median(depths)))
            found.append(LocalizedPose(localization, points, errors, probability))
        return refusal, found


def _place_probability(found: Localization) -> float:
    """Return the probability of the place.

    The result's probability also includes the precision, which does not affect other places.
    """
    if found.evidence is None:
        return found.probability
    return min(found.probability / found.evidence.precision_probability, 1.0)


def _is_known_pose(world_from_cam: Rigid3, found: list[LocalizedPose]) -> bool:
    return any(
        is_same_place(localized.result.world_from_cam, world_from_cam) for localized in found
    )


def reject_jump(found: Localization) -> NotLocalized:
    """Return the result for a pose that the motion does not allow."""
    return NotLocalized(
        "jump",
        found.candidates,
        found.num_matches,
        found.num_inliers,
        found.times_ms,
        provenance=found.provenance,
    )
