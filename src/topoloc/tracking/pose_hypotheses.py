"""Maintain weighted hypotheses about a stream's camera pose, each with its motion.

An image of a repetitive place may fit several poses, and an image is sometimes localized wrongly.
So a stream holds a set of hypotheses instead of one pose (multi-hypothesis filter: Reid, *An
algorithm for tracking multiple targets*, 1979).

Each hypothesis predicts the next pose. If the next result contains a consistent pose, the weight is
multiplied by its probability and likelihood. Otherwise it is multiplied by the probability that the
result misses the true pose. Poses consistent with no hypothesis start new ones, with the weight of
"elsewhere". Alternatives of two images taken close together have the same errors. They count only
by their share of new evidence. The same rule thus handles a camera that was carried, a wrong first
localization, and walls of equal panels. The motion of tracked points applies to all hypotheses.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from jaxtyping import Float
from msgspec import structs

from topoloc.geometry.rigid import Rigid3
from topoloc.localization.result import Alternative
from topoloc.node_ids import NodeId
from topoloc.tracking.gyroscope import Gyroscope
from topoloc.tracking.motion import (
    MeasuredTurn,
    MotionConfig,
    MotionHypothesis,
    MotionState,
    is_same_place,
    merge_duplicates,
    predict_motion,
    start_motion,
    update_motion,
)

_TRACKS = itertools.count(1)  # of all streams: one that starts anew has other numbers


@dataclass(frozen=True, eq=False)
class Candidate:
    """Hold a possible pose of the current image.

    `covariance` is that of the right perturbation, as everywhere below.
    """

    world_from_cam: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    probability: float
    node_id: NodeId


class PoseHypotheses:
    """Hold the hypotheses, highest weight first, and the weight of "elsewhere". All weights sum to
    one.

    `is_track_continued` is True if the best hypothesis was the best before this image, or follows
    from it. `is_turn_measured` is True if a gyroscope measured the rotation to this image.
    """

    miss: ClassVar[float] = 0.01
    """Probability that a localization is wrong."""
    prediction_scale: ClassVar[float] = 2.5
    """Factor on the sigma of the prediction, because hands jerk and wheels hit kerbs."""

    def __init__(
        self,
        motion: MotionConfig,
        prior: MotionHypothesis | None = None,
        gyroscope: Gyroscope | None = None,
    ) -> None:
        self.motion, self.is_track_continued = motion, False
        self._gyroscope, self.is_turn_measured = gyroscope, False
        self._ranked = list[MotionHypothesis]() if prior is None else [prior]
        self._null_weight = 1.0 if prior is None else 1.0 - prior.weight

    @property
    def best(self) -> MotionState | None:
        """Return the best hypothesis at the current image, None if the camera is lost."""
        return self._ranked[0].current if self._ranked else None

    @property
    def leader(self) -> MotionState:
        """Return the best hypothesis at the current image. Raises IndexError if there is none."""
        return self._ranked[0].current

    @property
    def track(self) -> int | None:
        """Return the number of the best hypothesis, which its later poses keep."""
        return self._ranked[0].track if self._ranked else None

    @property
    def candidate_idx(self) -> int | None:
        """Return the index of the candidate that the best hypothesis used."""
        return self._ranked[0].candidate_idx if self._ranked else None

    @property
    def is_unambiguous(self) -> bool:
        """Return whether one pose has enough weight, or there is no hypothesis."""
        # Minimum weight of a hypothesis to be reported as the pose. Otherwise the result
        # is `ambiguous`.
        min_probability = 0.9
        return not self._ranked or self.alternatives()[0].probability >= min_probability

    def alternatives(self) -> tuple[Alternative, ...]:
        """Return the poses at the current image, likeliest first. Hypotheses with the same pose
        and different velocities are merged."""
        found = list[Alternative]()
        for hypothesis in self._ranked:
            pose = hypothesis.current.world_from_cam
            for k, other in enumerate(found):
                if is_same_place(other.world_from_cam, pose):
                    found[k] = structs.replace(
                        other, probability=other.probability + hypothesis.weight
                    )
                    break
            else:
                found.append(Alternative(pose, hypothesis.weight, hypothesis.node_id))
        return tuple(sorted(found, key=lambda alternative: -alternative.probability))

    def seconds_since(self, t_ns: int) -> float:
        """Return the seconds since the last measured pose, infinite if there is none."""
        return (t_ns - self._ranked[0].state.t_ns) / 1e9 if self._ranked else float("inf")

    def predict(self, t_ns: int, odom_from_cam: Rigid3 | None = None) -> MotionState | None:
        """Predict all hypotheses at this time and return the best.

        Those without a measurement for too long are dropped.
        """
        max_seconds = 1.0  # seconds without a measured pose after which a hypothesis is dropped
        max_seconds_with_gyroscope = 3.0  # the same if the rotation is measured
        max_seconds_with_odometry = 20.0  # the same with external odometry
        before, alive = self._ranked, list[MotionHypothesis]()
        self.is_turn_measured = False
        for hypothesis in before:
            turn = self._measure_turn(hypothesis.state.t_ns, t_ns)
            motion, limit = None, max_seconds
            if turn is not None:
                self.is_turn_measured, limit = True, max_seconds_with_gyroscope
            if hypothesis.odom_from_cam is not None and odom_from_cam is not None:
                motion = hypothesis.odom_from_cam.inverse() @ odom_from_cam
                limit = max_seconds_with_odometry
            if t_ns - hypothesis.state.t_ns <= limit * 1e9:
                current = predict_motion(hypothesis.state, t_ns, self.motion, motion, turn)
                alive.append(replace(hypothesis, current=current, candidate_idx=None))
        self.is_track_continued = bool(alive) and alive[0].state is before[0].state
        left = sum(hypothesis.weight for hypothesis in alive)
        # dropped weight counts as "elsewhere"
        self._prune(alive if self.is_track_continued or left > 0.5 else [], 1.0 - left)
        return self.best

    def _measure_turn(self, start_ns: int, end_ns: int) -> MeasuredTurn | None:
        return None if self._gyroscope is None else self._gyroscope.measure_turn(start_ns, end_ns)

    def hold(self, t_ns: int, odom_from_cam: Rigid3 | None) -> None:
        """Move all hypotheses to a later time, because the camera stands since the last image,
        where odometry was `odom_from_cam`. Later motion is counted from there."""
        for number, one in enumerate(self._ranked):
            held = replace(one.current, t_ns=t_ns, velocity=np.zeros(6))
            self._ranked[number] = one.measured(held, odom_from_cam)

    def is_consistent(
        self, predicted: MotionState, world_from_cam: Rigid3, covariance: Float[np.ndarray, "6 6"]
    ) -> bool:
        """Return whether this pose is consistent with a prediction."""
        # Maximum squared Mahalanobis distance of a consistent pose from the prediction
        # (chi^2 with 6 degrees of freedom: 1 in 100,000).
        max_surprise = 33.0
        return predicted.world_from_cam.is_same(
            world_from_cam,
            covariance=self._gate_covariance(predicted, covariance),
            max_square=max_surprise,
        )

    def is_expected(self, candidate: Candidate) -> bool:
        """Return whether a pose is consistent with the best hypothesis."""
        best, pose = self.best, candidate.world_from_cam
        return best is not None and self.is_consistent(best, pose, candidate.covariance)

    def _gate_covariance(
        self, predicted: MotionState, covariance: Float[np.ndarray, "6 6"]
    ) -> Float[np.ndarray, "6 6"]:
        return self.prediction_scale**2 * predicted.pose_covariance + covariance

    def apply_motion(
        self,
        world_from_cam: Rigid3,
        covariance: Float[np.ndarray, "6 6"],
        odom_from_cam: Rigid3 | None,
    ) -> None:
        """Update all hypotheses with tracked points. The points measure the best hypothesis at
        this pose. The others move by the same motion."""
        self._ranked = [
            hypothesis.measured(
                update_motion(
                    hypothesis.current, hypothesis.from_best @ world_from_cam, covariance
                ),
                odom_from_cam,
            )
            for hypothesis in self._ranked
        ]

    def update_weights(
        self,
        t_ns: int,
        candidates: Sequence[Candidate],
        odom_from_cam: Rigid3 | None = None,
        new_evidence_ratio: float = 1.0,
    ) -> None:
        """Update the hypotheses with the result of the image.

        The candidates exclude each other. Without candidates, a place outside the map becomes a
        little likelier.

        Args:
            new_evidence_ratio: share of the evidence that is new since the preceding images.
        """
        # Share of its weight that a hypothesis keeps, relative to "elsewhere", after an
        # image without a pose.
        kept_share = 0.6
        miss_ambiguous = 0.1  # minimum probability that the true pose is not among the alternatives
        if not candidates:
            kept = [
                replace(hypothesis, weight=kept_share * hypothesis.weight)
                for hypothesis in self._ranked
            ]
            self._prune(kept, self._null_weight)
            return
        before, is_single = self.best, len(candidates) == 1
        none = max(
            self.miss if is_single else miss_ambiguous,
            1.0 - sum(candidate.probability for candidate in candidates),
        )
        new, others = list[MotionHypothesis](), self._ranked
        if is_single:
            new, others = self._merge_consistent(candidates[0], odom_from_cam, new_evidence_ratio)
        for hypothesis in others:
            updated = (
                self._update_with_candidate(hypothesis, number, candidate, odom_from_cam)
                for number, candidate in enumerate(candidates)
            )
            children = [child for child in updated if child is not None]
            children.append(replace(hypothesis, weight=hypothesis.weight * none))
            gain = sum(child.weight for child in children) / hypothesis.weight
            factor = gain ** (new_evidence_ratio - 1.0)
            new += [replace(child, weight=child.weight * factor) for child in children]
        for number, candidate in enumerate(candidates):
            weight = self._null_weight * candidate.probability * new_evidence_ratio
            own = [k for k, hypothesis in enumerate(new) if hypothesis.candidate_idx == number]
            heaviest = max(own, key=lambda k: new[k].weight, default=None)
            if heaviest is not None and new[heaviest].weight >= weight:
                new[heaviest] = replace(new[heaviest], weight=new[heaviest].weight + weight)
            else:
                state = start_motion(t_ns, candidate.world_from_cam, candidate.covariance)
                pose, node_id = Rigid3.identity(), candidate.node_id
                known = state, odom_from_cam, state, weight, node_id, pose, number, next(_TRACKS)
                new.append(MotionHypothesis(*known))
        self._prune(merge_duplicates(new), self._null_weight * none**new_evidence_ratio)
        best = self.leader
        self.is_track_continued = before is not None and self.is_consistent(
            before, best.world_from_cam, best.pose_covariance
        )
        self._update_relative_poses()

    def set_best_state(self, state: MotionState, odom_from_cam: Rigid3 | None) -> None:
        """Replace the state of the best hypothesis by a more accurate one than its candidate
        gives."""
        self._ranked[0] = self._ranked[0].measured(state, odom_from_cam)
        self._update_relative_poses()

    def _merge_consistent(
        self, candidate: Candidate, odom_from_cam: Rigid3 | None, new_evidence_ratio: float
    ) -> tuple[list[MotionHypothesis], list[MotionHypothesis]]:
        """Merge the hypotheses consistent with a single pose into one. Return it, and the others.

        The motion is that of the likeliest of them.
        """
        pose, covariance = candidate.world_from_cam, candidate.covariance
        weight, likeliest, others = (
            0.0,
            list[tuple[float, MotionHypothesis]](),
            list[MotionHypothesis](),
        )
        for hypothesis in self._ranked:
            updated = self._update_with_candidate(hypothesis, 0, candidate, odom_from_cam)
            if updated is None:
                others.append(hypothesis)
                continue
            predicted = hypothesis.current.world_from_cam
            gate = self._gate_covariance(hypothesis.current, covariance)
            surprised = math.exp(-0.5 * predicted.squared_distance(pose, gate))
            weight += hypothesis.weight * (candidate.probability * surprised) ** new_evidence_ratio
            both = hypothesis.current.pose_covariance + covariance
            spread = float(np.linalg.slogdet(both)[1])
            square = predicted.squared_distance(pose, both)
            likeliest.append((math.log(hypothesis.weight) - 0.5 * (square + spread), updated))
        if not likeliest:
            return [], others
        _, best = max(likeliest, key=lambda pair: pair[0])
        return [replace(best, weight=weight)], others

    def _update_with_candidate(
        self,
        hypothesis: MotionHypothesis,
        number: int,
        candidate: Candidate,
        odom_from_cam: Rigid3 | None,
    ) -> MotionHypothesis | None:
        """Return the hypothesis updated by a candidate, weighted by its likelihood.

        None if the candidate is not consistent with it.
        """
        pose, covariance, now = candidate.world_from_cam, candidate.covariance, hypothesis.current
        if not self.is_consistent(now, pose, covariance):
            return None
        square = now.world_from_cam.squared_distance(pose, now.pose_covariance + covariance)
        weight = hypothesis.weight * candidate.probability * max(math.exp(-0.5 * square), 1e-100)
        state, changes = update_motion(now, pose, covariance), {"node_id": candidate.node_id}
        return hypothesis.measured(
            state, odom_from_cam, weight=weight, candidate_idx=number, **changes
        )

    def _prune(self, hypotheses: list[MotionHypothesis], elsewhere: float) -> None:
        """Keep the hypotheses with the highest weights and normalise the weights."""
        max_number = 24  # maximum number of hypotheses, those with the highest weights
        min_weight = 0.002  # minimum weight of a hypothesis
        # Minimum probability that the camera is at none of the hypotheses, because it was
        # carried or all are wrong.
        min_elsewhere = 0.0005
        whole = sum(hypothesis.weight for hypothesis in hypotheses) + elsewhere
        heaviest = sorted(hypotheses, key=lambda hypothesis: -hypothesis.weight)[:max_number]
        kept = [
            hypothesis for hypothesis in heaviest if hypothesis.weight >= min_weight * whole
        ] or heaviest[:1]
        self._null_weight = max(elsewhere / whole, min_elsewhere) if kept else 1.0
        share = (1.0 - self._null_weight) / max(
            sum(hypothesis.weight for hypothesis in kept), 1e-300
        )
        self._ranked = [
            replace(hypothesis, weight=share * hypothesis.weight) for hypothesis in kept
        ]

    def _update_relative_poses(self) -> None:
        """Compute the transforms from the best hypothesis to each one."""
        best_from_world = self._ranked[0].current.world_from_cam.inverse()
        self._ranked = [
            replace(hypothesis, from_best=hypothesis.current.world_from_cam @ best_from_world)
            for hypothesis in self._ranked
        ]
