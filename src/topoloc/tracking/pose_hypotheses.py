"""What is believed of where a stream's camera is: several hypotheses, each with its motion and its
weight.

A picture of a place that repeats itself may have been taken at any of several poses, and now and
then a picture is placed wrongly. So a stream believes not one pose but a set of them (a
multi-hypothesis filter: Reid, *An algorithm for tracking multiple targets*, 1979). Each hypothesis
predicts the next pose. Where the next picture's answer has a pose that follows, it gains by the
probability of that pose and by how little this surprises; where it has none, the probability of an
answer that misses the true pose is left. Poses that follow from nothing begin hypotheses at the
weight of "elsewhere". Alternatives of two pictures taken close together err alike: what they say
counts by the share of it that is new. So a camera that was carried, a stream that was placed
wrongly to begin with, and walls of equal panels are decided alike. What followed points show of the
motion is true of all hypotheses, and moves them together.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float

from topoloc.bounds import Above, AtLeast, Between
from topoloc.geometry.alignment import translation_error
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.result import Alternative
from topoloc.tracking.motion import (
    MotionConfig,
    MotionState,
    predict_motion,
    squared_mahalanobis,
    start_motion,
    update_motion,
)


@dataclass(frozen=True)
class HypothesesConfig:
    """What follows from what, what is believed, and how far a prediction reaches."""

    motion: MotionConfig = field(default_factory=MotionConfig)
    max_surprise: Annotated[float, Above(0)] = 33.0
    """Squared Mahalanobis distance from the prediction (chi^2 with 6 degrees of freedom: 1 in
    100,000), beyond which no pose follows."""
    prediction_scale: Annotated[float, Above(0)] = 2.5
    """By how much the prediction may be more wrong than its sigma says: hands jerk, wheels meet
    kerbs."""
    min_probability: Annotated[float, Between(0.5, 1)] = 0.9
    """A hypothesis that has so much of all weight is the pose; while none has, the answer is
    `ambiguous`."""
    miss: Annotated[float, Between(1e-6, 0.5)] = 0.01
    """Probability that a localization is wrong ..."""
    miss_ambiguous: Annotated[float, Between(1e-6, 0.5)] = 0.1
    """... and that the true pose is not among alternatives, at least."""
    renewal: Annotated[float, Above(0)] = 1.0
    """Motion (way in depths of the points, plus radians) after which what alternatives say is new
    (but for 1/e) ..."""
    renewal_alone: Annotated[float, Above(0)] = 0.1
    """... and what a single pose says that is less sure than a localization can be."""
    refused: Annotated[float, Between(0.01, 1)] = 0.6
    """Share of its weight that a hypothesis keeps, beside "elsewhere", with a picture that gets no
    pose: it should have had one there."""
    elsewhere: Annotated[float, Between(1e-9, 0.5)] = 0.0005
    """Probability that the camera is at none of the hypotheses, at least: it was carried, or all of
    them are wrong."""
    max_number: Annotated[int, Between(1, 1000)] = 24
    """The heaviest hypotheses are kept, so many ..."""
    min_weight: Annotated[float, Between(0, 0.1)] = 0.002
    """... of at least this share of all weight."""
    max_asked: Annotated[int, AtLeast(0)] = 8
    """Around so many of them, the heaviest, a picture is sought where the answer leaves them
    out."""
    max_predicted: Annotated[float, AtLeast(0)] = 1.0
    """Seconds without a measured pose after which a hypothesis is given up ..."""
    max_predicted_with_odometry: Annotated[float, AtLeast(0)] = 20.0
    """... or with external odometry."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A pose that the picture at hand may have. `covariance` is here, as everywhere below, of the
    right perturbation."""

    world_from_cam: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    probability: float
    node_id: int


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    """`state` is of the pose measured last, `odom_from_cam` of that moment, `now` the state at the
    picture at hand.

    `from_best` takes poses of the best hypothesis into those of this one, whatever the motion since
    they were compared. `candidate_idx` is the number of the candidate that it took of this
    picture's, None where none.
    """

    state: MotionState
    odom_from_cam: Rigid3 | None
    current: MotionState
    weight: float
    node_id: int
    from_best: Rigid3
    candidate_idx: int | None


class PoseHypotheses:
    """The hypotheses, the heaviest first, and the weight of "elsewhere"; all weights sum to one.

    `is_track_continued`: the heaviest one is the one that was so before this picture, or follows
    from it.
    """

    def __init__(self, config: HypothesesConfig) -> None:
        self.config = config
        self.clear()

    def clear(self) -> None:
        """Nothing is known."""
        self._ranked: list[_Hypothesis] = []
        self._null_weight, self.is_track_continued = 1.0, False

    @property
    def best(self) -> MotionState | None:
        """The heaviest hypothesis at the picture at hand; None where the camera is lost."""
        return self._ranked[0].current if self._ranked else None

    @property
    def candidate_idx(self) -> int | None:
        """The number of the candidate that the heaviest hypothesis took."""
        return self._ranked[0].candidate_idx if self._ranked else None

    @property
    def is_unambiguous(self) -> bool:
        """Whether one pose leads clearly, or there is none at all."""
        return not self._ranked or self.alternatives()[0].probability >= self.config.min_probability

    def alternatives(self) -> tuple[Alternative, ...]:
        """The poses at the picture at hand, the likeliest first; hypotheses of one pose that differ
        in their velocity are one."""
        found: list[Alternative] = []
        for one in self._ranked:
            pose = one.current.world_from_cam
            known = next(
                (k for k, other in enumerate(found) if is_same_pose(other.world_from_cam, pose)),
                None,
            )
            if known is None:
                found.append(Alternative(pose, one.weight, one.node_id))
            else:
                found[known] = replace(
                    found[known], probability=found[known].probability + one.weight
                )
        return tuple(sorted(found, key=lambda one: -one.probability))

    def seconds_since(self, t_ns: int) -> float:
        """Seconds from the pose measured last to this time; infinite where there is none."""
        return (t_ns - self._ranked[0].state.t_ns) / 1e9 if self._ranked else float("inf")

    def predict(self, t_ns: int, odom_from_cam: Rigid3 | None = None) -> MotionState | None:
        """Where the best hypothesis has the camera at this time; those not measured for too long
        are given up."""
        config, before, alive = self.config, self._ranked, list[_Hypothesis]()
        for one in before:
            before_from_cam = _relative_odometry(one.odom_from_cam, odom_from_cam)
            limit = (
                config.max_predicted
                if before_from_cam is None
                else config.max_predicted_with_odometry
            )
            if t_ns - one.state.t_ns <= limit * 1e9:
                alive.append(
                    replace(
                        one,
                        current=predict_motion(one.state, t_ns, config.motion, before_from_cam),
                        candidate_idx=None,
                    )
                )
        self.is_track_continued = bool(alive) and alive[0].state is before[0].state
        left = sum(one.weight for one in alive)
        self._prune(
            alive if self.is_track_continued or left > 0.5 else [], 1.0 - left
        )  # who was given up is elsewhere: what is left beside it is no belief
        return self.best

    def is_consistent(
        self, predicted: MotionState, world_from_cam: Rigid3, covariance: Float[np.ndarray, "6 6"]
    ) -> bool:
        """Whether this pose can follow from a prediction."""
        return (
            self._compute_gated_distance(predicted, world_from_cam, covariance)
            <= self.config.max_surprise
        )

    def _compute_gated_distance(
        self, predicted: MotionState, world_from_cam: Rigid3, covariance: Float[np.ndarray, "6 6"]
    ) -> float:
        slack = (self.config.prediction_scale**2 - 1.0) * predicted.pose_covariance
        return squared_mahalanobis(predicted, world_from_cam, covariance + slack)

    def apply_motion(
        self,
        world_from_cam: Rigid3,
        covariance: Float[np.ndarray, "6 6"],
        odom_from_cam: Rigid3 | None,
    ) -> None:
        """Followed points show the best hypothesis at this pose, and so each other one where the
        same motion takes it."""
        for k, one in enumerate(self._ranked):
            current = update_motion(one.current, one.from_best @ world_from_cam, covariance)
            self._ranked[k] = replace(
                one, state=current, current=current, odom_from_cam=odom_from_cam
            )

    def update_weights(
        self,
        t_ns: int,
        candidates: Sequence[Candidate],
        odom_from_cam: Rigid3 | None = None,
        new_evidence_ratio: float = 1.0,
    ) -> None:
        """What the picture's answer makes of the hypotheses, if this share of what it says is new.

        The candidates exclude each other; where there are none, a place that is not in the map is a
        little likelier.
        """
        if not candidates:
            self._prune(
                [replace(one, weight=self.config.refused * one.weight) for one in self._ranked],
                self._null_weight,
            )
            return
        before, miss = (
            self.best,
            self.config.miss if len(candidates) == 1 else self.config.miss_ambiguous,
        )
        none = max(miss, 1.0 - sum(one.probability for one in candidates))
        new = (
            self._merge_consistent(candidates[0], odom_from_cam, new_evidence_ratio)
            if len(candidates) == 1
            else []
        )
        for one in self._ranked:
            if new and self.is_consistent(
                one.current, candidates[0].world_from_cam, candidates[0].covariance
            ):
                continue  # it is that one
            updated = [
                self._update_with_candidate(one, number, candidate, odom_from_cam)
                for number, candidate in enumerate(candidates)
            ]
            children = [child for child in updated if child is not None]
            children.append(replace(one, weight=one.weight * none))
            gain = sum(child.weight for child in children) / one.weight
            new += [
                replace(child, weight=child.weight * gain ** (new_evidence_ratio - 1.0))
                for child in children
            ]
        for number, candidate in enumerate(candidates):
            weight = self._null_weight * candidate.probability * new_evidence_ratio
            heaviest = max(
                (one for one in new if one.candidate_idx == number),
                key=lambda one: one.weight,
                default=None,
            )
            if heaviest is not None and heaviest.weight >= weight:
                new[new.index(heaviest)] = replace(heaviest, weight=heaviest.weight + weight)
            else:
                state = start_motion(
                    t_ns, candidate.world_from_cam, candidate.covariance, self.config.motion
                )
                new.append(
                    _Hypothesis(
                        state,
                        odom_from_cam,
                        state,
                        weight,
                        candidate.node_id,
                        Rigid3.identity(),
                        number,
                    )
                )
        self._prune(_merge_duplicates(new), self._null_weight * none**new_evidence_ratio)
        best = self._ranked[0].current
        self.is_track_continued = before is not None and self.is_consistent(
            before, best.world_from_cam, best.pose_covariance
        )
        self._update_relative_poses()

    def set_best_state(self, state: MotionState, odom_from_cam: Rigid3 | None) -> None:
        """The heaviest hypothesis is in this state: its pose is known better than from the
        candidate that it took."""
        self._ranked[0] = replace(
            self._ranked[0], state=state, current=state, odom_from_cam=odom_from_cam
        )
        self._update_relative_poses()

    def _merge_consistent(
        self, candidate: Candidate, odom_from_cam: Rigid3 | None, new_evidence_ratio: float
    ) -> list[_Hypothesis]:
        """The hypotheses that a sure pose follows from, as one: there they all are. The motion is
        that of the likeliest of them."""
        pose, covariance = candidate.world_from_cam, candidate.covariance
        weight, likeliest = 0.0, (-math.inf, None)
        for one in self._ranked:
            if (
                updated := self._update_with_candidate(one, 0, candidate, odom_from_cam)
            ) is not None:
                surprised = math.exp(
                    -0.5 * self._compute_gated_distance(one.current, pose, covariance)
                )
                weight += one.weight * (candidate.probability * surprised) ** new_evidence_ratio
                spread = float(np.linalg.slogdet(one.current.pose_covariance + covariance)[1])
                density = math.log(one.weight) - 0.5 * (
                    squared_mahalanobis(one.current, pose, covariance) + spread
                )
                likeliest = max(likeliest, (density, updated), key=lambda pair: pair[0])
        return [] if likeliest[1] is None else [replace(likeliest[1], weight=weight)]

    def _update_with_candidate(
        self, one: _Hypothesis, number: int, candidate: Candidate, odom_from_cam: Rigid3 | None
    ) -> _Hypothesis | None:
        """The hypothesis that the picture was taken there, less likely the more that surprises;
        None where it does not follow."""
        pose, covariance = candidate.world_from_cam, candidate.covariance
        if not self.is_consistent(one.current, pose, covariance):
            return None
        state = update_motion(one.current, pose, covariance)
        likelihood = max(
            math.exp(-0.5 * squared_mahalanobis(one.current, pose, covariance)), 1e-100
        )
        return _Hypothesis(
            state,
            odom_from_cam,
            state,
            one.weight * candidate.probability * likelihood,
            candidate.node_id,
            one.from_best,
            number,
        )

    def _prune(self, hypotheses: list[_Hypothesis], elsewhere: float) -> None:
        """The heaviest of these."""
        config = self.config
        whole = sum(one.weight for one in hypotheses) + elsewhere
        heaviest = sorted(hypotheses, key=lambda one: -one.weight)[: config.max_number]
        kept = [one for one in heaviest if one.weight >= config.min_weight * whole] or heaviest[:1]
        self._null_weight = max(elsewhere / whole, config.elsewhere) if kept else 1.0
        share = (1.0 - self._null_weight) / max(sum(one.weight for one in kept), 1e-300)
        self._ranked = [replace(one, weight=share * one.weight) for one in kept]

    def _update_relative_poses(self) -> None:
        """From where the best hypothesis is to where each is."""
        best_from_world = self._ranked[0].current.world_from_cam.inverse()
        self._ranked = [
            replace(one, from_best=one.current.world_from_cam @ best_from_world)
            for one in self._ranked
        ]


def _merge_duplicates(hypotheses: list[_Hypothesis]) -> list[_Hypothesis]:
    """Those that agree in pose and velocity become one, of what was measured now where there is a
    choice."""
    kept: list[_Hypothesis] = []
    least = 1e-4 * max(one.weight for one in hypotheses)
    for one in sorted(
        (one for one in hypotheses if one.weight > least),
        key=lambda one: (one.candidate_idx is None, -one.weight),
    ):
        same = next(
            (k for k, other in enumerate(kept) if _is_same_motion(one.current, other.current)), None
        )
        if same is None:
            kept.append(one)
        else:
            kept[same] = replace(kept[same], weight=kept[same].weight + one.weight)
    return kept


def _is_same_motion(a: MotionState, b: MotionState) -> bool:
    """Nearer in pose and velocity than what is left open of both would have them by chance every
    other time."""
    error = np.concatenate(
        [(a.world_from_cam.inverse() @ b.world_from_cam).log(), b.velocity - a.velocity]
    )
    return float(error @ np.linalg.solve(a.covariance + b.covariance, error)) < 6.0


def is_same_pose(a: Rigid3, b: Rigid3) -> bool:
    """As near as two right answers can be (`Localization.probability`)."""
    return translation_error(a, b) < 0.25 and (a.inverse() @ b).angle() < math.radians(5.0)


def _relative_odometry(
    odom_from_before: Rigid3 | None, odom_from_cam: Rigid3 | None
) -> Rigid3 | None:
    """The motion that external odometry saw, where it was there both times."""
    if odom_from_before is None or odom_from_cam is None:
        return None
    return odom_from_before.inverse() @ odom_from_cam
