"""What is believed of where a stream's camera is: several hypotheses, each with its motion and its weight.

One picture of a place that repeats itself may have been taken at any of several poses, and now and then a picture is placed wrongly. So what
follows from a picture's answer is not one pose but a set (a multi-hypothesis filter: Reid, *An algorithm for tracking multiple
targets*, 1979). Each hypothesis predicts the next pose. It gains where the next picture's answer has a pose that follows from it, by the probability of
that pose and by how little it surprises; where the answer has none, it keeps the small weight of an answer that misses the
true pose. Poses that follow from nothing begin hypotheses of their own, at the weight of "elsewhere". A camera that was carried elsewhere, a
stream that was placed wrongly to begin with, and walls of equal panels are all decided so. The motion that followed points show is the
same for all hypotheses: it moves them together.
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
from topoloc.tracking.motion import MotionConfig, MotionState, predict_motion, start_motion, surprise, update_motion


@dataclass(frozen=True)
class HypothesesConfig:
    """What follows from what, what is believed, and how far a prediction reaches."""

    motion: MotionConfig = field(default_factory=MotionConfig)
    max_surprise: Annotated[float, Above(0)] = 33.0
    """Squared Mahalanobis distance from the prediction (chi^2 with 6 degrees of freedom: 1 in 100,000) beyond which a pose does not follow."""
    prediction_scale: Annotated[float, Above(0)] = 2.5
    """By how much the prediction may be more wrong than its sigma says: hands jerk, wheels meet kerbs."""
    min_probability: Annotated[float, Between(0.5, 1)] = 0.95
    """A hypothesis that has so much of all weight is the pose; while none has, the answer is `ambiguous`."""
    miss: Annotated[float, Between(1e-6, 0.5)] = 0.02
    """Probability that a localization is wrong ..."""
    miss_ambiguous: Annotated[float, Between(1e-6, 0.5)] = 0.1
    """... and that the true pose is not among alternatives, at least."""
    elsewhere: Annotated[float, Between(1e-9, 0.5)] = 0.001
    """Probability that the camera is at none of the hypotheses, at least: it was carried, or all of them are wrong."""
    max_number: Annotated[int, Between(1, 1000)] = 24
    """The heaviest hypotheses are kept, so many ..."""
    min_weight: Annotated[float, Between(0, 0.1)] = 0.002
    """... of at least this share of all weight."""
    max_asked: Annotated[int, AtLeast(0)] = 8
    """Around so many of them, the heaviest, a picture is sought where the answer leaves them out."""
    max_predicted: Annotated[float, AtLeast(0)] = 1.0
    """Seconds without a measured pose after which a hypothesis is given up ..."""
    max_predicted_with_odometry: Annotated[float, AtLeast(0)] = 20.0
    """... or with external odometry."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A pose that the picture at hand may have. `covariance` is here, as everywhere below, of the right perturbation."""

    world_from_cam: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    probability: float
    node_id: int


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    """`state` is of the pose measured last, `odom_from_cam` of that moment, `now` the state at the picture at hand.

    `from_best` takes poses of the best hypothesis into those of this one: where the motion is known, it does not change.
    `taken` is the number of the candidate that it took last, None where it took none of those.
    """

    state: MotionState
    odom_from_cam: Rigid3 | None
    now: MotionState
    weight: float
    node_id: int
    from_best: Rigid3
    taken: int | None


class PoseHypotheses:
    """The hypotheses, the heaviest first, and the weight of "elsewhere"; all weights sum to one.

    `continues`: after what was weighed last, the heaviest one is where the one before lets expect.
    """

    def __init__(self, config: HypothesesConfig) -> None:
        self.config = config
        self.forget()

    def forget(self) -> None:
        """Nothing is known."""
        self._alive: list[_Hypothesis] = []
        self._elsewhere = 1.0
        self.continues = False

    @property
    def is_alive(self) -> bool:
        """Whether anything is believed."""
        return bool(self._alive)

    @property
    def has_rivals(self) -> bool:
        """Whether there is more than one place."""
        return len(self.alternatives()) > 1

    @property
    def best(self) -> MotionState:
        """The heaviest hypothesis at the picture at hand."""
        return self._alive[0].now

    @property
    def taken(self) -> int | None:
        """Which of the candidates weighed last is that of the heaviest hypothesis."""
        return self._alive[0].taken if self._alive else None

    @property
    def is_decided(self) -> bool:
        """Whether one pose leads clearly, or there is none at all."""
        return not self._alive or self.alternatives()[0].probability >= self.config.min_probability

    def alternatives(self) -> tuple[Alternative, ...]:
        """The poses at the picture at hand, the likeliest first; hypotheses of one pose that differ in their velocity are one."""
        found: list[Alternative] = []
        for one in self._alive:
            pose = one.now.world_from_cam
            known = next((k for k, other in enumerate(found) if is_same_place(other.world_from_cam, pose)), None)
            if known is None:
                found.append(Alternative(pose, one.weight, one.node_id))
            else:
                found[known] = replace(found[known], probability=found[known].probability + one.weight)
        return tuple(sorted(found, key=lambda one: -one.probability))

    def seconds_since(self, t_ns: int) -> float:
        """Seconds from the pose measured last to this time; infinite where there is none."""
        return (t_ns - self._alive[0].state.t_ns) / 1e9 if self._alive else float("inf")

    def predict(self, t_ns: int, odom_from_cam: Rigid3 | None = None) -> MotionState | None:
        """Where the best hypothesis has the camera at this time; None where it is lost."""
        config, alive = self.config, list[_Hypothesis]()
        for one in self._alive:
            before_from_cam = _since(one.odom_from_cam, odom_from_cam)
            limit = config.max_predicted if before_from_cam is None else config.max_predicted_with_odometry
            if t_ns - one.state.t_ns <= limit * 1e9:
                alive.append(replace(one, now=predict_motion(one.state, t_ns, config.motion, before_from_cam), taken=None))
        self._keep(alive, self._elsewhere if alive else 1.0)
        return self._alive[0].now if self._alive else None

    def follows(self, predicted: MotionState, world_from_cam: Rigid3, covariance: Float[np.ndarray, "6 6"]) -> bool:
        """Whether this pose can follow from a prediction."""
        slack = (self.config.prediction_scale**2 - 1.0) * predicted.pose_covariance
        return surprise(predicted, world_from_cam, covariance + slack) <= self.config.max_surprise

    def move(self, world_from_cam: Rigid3, covariance: Float[np.ndarray, "6 6"], odom_from_cam: Rigid3 | None) -> None:
        """Followed points show the best hypothesis at this pose, and so each other one where the same motion takes it."""
        for k, one in enumerate(self._alive):
            now = update_motion(one.now, one.from_best @ world_from_cam, covariance)
            self._alive[k] = replace(one, state=now, now=now, odom_from_cam=odom_from_cam)

    def weigh(self, t_ns: int, candidates: Sequence[Candidate], odom_from_cam: Rigid3 | None = None) -> None:
        """What the picture's answer makes of the hypotheses. Both exclude each other; where there are no candidates, nothing is learnt."""
        if not candidates:
            self.continues = self.is_alive
            return
        miss = self.config.miss if len(candidates) == 1 else self.config.miss_ambiguous
        none = max(miss, 1.0 - sum(one.probability for one in candidates))
        new: list[_Hypothesis] = []
        for one in self._alive:
            children = [self._taking(one, number, candidate, odom_from_cam) for number, candidate in enumerate(candidates)]
            children = [child for child in children if child is not None]
            new += children
            if len(candidates) > 1 or not children:
                new.append(replace(one, weight=one.weight * none))
        for number, candidate in enumerate(candidates):
            weight = self._elsewhere * candidate.probability
            of_it = [k for k, one in enumerate(new) if one.taken == number]
            if of_it:
                heaviest = max(of_it, key=lambda k: new[k].weight)
                new[heaviest] = replace(new[heaviest], weight=new[heaviest].weight + weight)
            else:
                state = start_motion(t_ns, candidate.world_from_cam, candidate.covariance, self.config.motion)
                new.append(_Hypothesis(state, odom_from_cam, state, weight, candidate.node_id, Rigid3.identity(), number))
        before = self._alive[0].now if self._alive else None
        self._keep(_merged(new), self._elsewhere * none)
        self.continues = before is not None and self.follows(before, self.best.world_from_cam, self.best.pose_covariance)
        self._compare()

    def correct(self, state: MotionState, odom_from_cam: Rigid3 | None) -> None:
        """The heaviest hypothesis is in this state: its pose is known better than from the candidate that it took."""
        self._alive[0] = replace(self._alive[0], state=state, now=state, odom_from_cam=odom_from_cam)
        self._compare()

    def _taking(self, one: _Hypothesis, number: int, candidate: Candidate, odom_from_cam: Rigid3 | None) -> _Hypothesis | None:
        """The hypothesis that the picture was taken there; None where that does not follow."""
        pose, covariance = candidate.world_from_cam, candidate.covariance
        if not self.follows(one.now, pose, covariance):
            return None
        state = update_motion(one.now, pose, covariance)
        weight = one.weight * candidate.probability * math.exp(-0.5 * surprise(one.now, pose, covariance))
        return _Hypothesis(state, odom_from_cam, state, weight, candidate.node_id, one.from_best, number)

    def _keep(self, hypotheses: list[_Hypothesis], elsewhere: float) -> None:
        """The heaviest of these."""
        config = self.config
        whole = sum(one.weight for one in hypotheses) + elsewhere
        heaviest = sorted(hypotheses, key=lambda one: -one.weight)[: config.max_number]
        kept = [one for one in heaviest if one.weight >= config.min_weight * whole]
        self._elsewhere = max(elsewhere / whole, config.elsewhere) if kept else 1.0
        share = (1.0 - self._elsewhere) / max(sum(one.weight for one in kept), 1e-300)
        self._alive = [replace(one, weight=share * one.weight) for one in kept]

    def _compare(self) -> None:
        """From where the best hypothesis is to where each is."""
        if self._alive:
            best_from_world = self.best.world_from_cam.inverse()
            self._alive = [replace(one, from_best=one.now.world_from_cam @ best_from_world) for one in self._alive]


def _merged(hypotheses: list[_Hypothesis]) -> list[_Hypothesis]:
    """Those that agree in pose and velocity become one, of what was measured now where there is a choice."""
    kept: list[_Hypothesis] = []
    for one in sorted(hypotheses, key=lambda one: (one.taken is None, -one.weight)):
        same = next((k for k, other in enumerate(kept) if _is_same_motion(one.now, other.now)), None)
        if same is None:
            kept.append(one)
        else:
            kept[same] = replace(kept[same], weight=kept[same].weight + one.weight)
    return kept


def _is_same_motion(a: MotionState, b: MotionState) -> bool:
    """Nearer in pose and velocity than what is left open of both would have them by chance every other time."""
    error = np.concatenate([(a.world_from_cam.inverse() @ b.world_from_cam).log(), b.velocity - a.velocity])
    return float(error @ np.linalg.solve(a.covariance + b.covariance, error)) < 6.0


def is_same_place(a: Rigid3, b: Rigid3) -> bool:
    """As near as two right answers can be (`Localization.probability`)."""
    return translation_error(a, b) < 0.25 and (a.inverse() @ b).angle() < math.radians(5.0)


def _since(odom_from_before: Rigid3 | None, odom_from_cam: Rigid3 | None) -> Rigid3 | None:
    """The motion that external odometry saw, where it was there both times."""
    if odom_from_before is None or odom_from_cam is None:
        return None
    return odom_from_before.inverse() @ odom_from_cam
