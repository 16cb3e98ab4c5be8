"""Derive the certificate of a map from answers: independent pieces, and a bound of wrong ones.

Images of one walk are not independent: neighbours see the same things and fail together. So images
near each other form one piece, and a piece is wrong if any of its answers is. Of n pieces with k
wrong ones, Clopper and Pearson (*Biometrika* 26, 1934) give an upper bound of the share.

The threshold of the probability is the least one whose bound keeps a limit. The share of wrong
pieces falls as the threshold rises, so the bound also holds for the chosen threshold (Bates et al.,
"Distribution-free, risk-controlling prediction sets", *J. ACM* 68, 2021; Angelopoulos et al.,
"Conformal risk control", *ICLR* 2024).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from itertools import compress, groupby, pairwise
from math import exp, lgamma, log, log1p

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from msgspec import to_builtins

from topoloc import EvaluatedQuery, Evaluation, Localization, LocalizerConfig, Rigid3, TopoMetricMap
from topoloc.apps.core_names import (
    Certificate,
    CertifiedCondition,
    CertifiedGroup,
    ConditionKind,
    GroupKind,
    NodePoses,
    node_distances,
    to_grey,
    today,
)

CONFIDENCE = 0.95
GROUP_BOUNDS: dict[GroupKind, tuple[float, ...]] = {
    "angle": (0.0, 10.0, 30.0, math.inf),
    "light": (1.0, 1.25, 2.0, math.inf),
}
"""Bounds of the groups, fixed so that a promise is about the same images in each map."""
_PIECE_D_THRESH = 5.0
"""Images further apart than this many D_thresh (Eq. 1) are independent: no node serves both."""
_THUMBNAIL_PX = 32
_SAME_CORRELATION = 0.5
"""Correlation of the thumbnails of images without poses from which on they show the same."""


def pieces_by_pose(
    poses: Sequence[Rigid3], d_thresh: float, lambda_rot: float
) -> Int[np.ndarray, " n"]:
    """Return the number of the piece of each pose (world_from_cam). A pose joins the nearest first
    pose of a piece within five D_thresh, also if the walk comes back later."""
    firsts, numbers = list[Rigid3](), list[int]()
    for pose in poses:
        distances = node_distances(pose, NodePoses.from_poses(firsts), lambda_rot)
        nearest = int(np.argmin(distances)) if firsts else -1
        if not firsts or distances[nearest] > _PIECE_D_THRESH * d_thresh:
            nearest = len(firsts)
            firsts.append(pose)
        numbers.append(nearest)
    return np.array(numbers, int)


def thumbnail(grey: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, " 1024"]:
    """Return a small copy of an image with zero mean and unit length."""
    small = cv2.resize(grey, (_THUMBNAIL_PX, _THUMBNAIL_PX), interpolation=cv2.INTER_AREA)
    values = small.astype(float).ravel()
    values -= values.mean()
    return values / max(float(np.linalg.norm(values)), 1e-9)


def pieces_by_look(thumbnails: Float[np.ndarray, "n 1024"]) -> Int[np.ndarray, " n"]:
    """Return the number of the piece of each image, by its thumbnail. An image joins the piece
    whose first image looks most like it, if it does."""
    firsts, numbers = list[int](), list[int]()
    for row, one in enumerate(thumbnails):
        likeness = thumbnails[firsts] @ one
        nearest = int(np.argmax(likeness)) if firsts else -1
        if not firsts or likeness[nearest] < _SAME_CORRELATION:
            nearest = len(firsts)
            firsts.append(row)
        numbers.append(nearest)
    return np.array(numbers, int)


def max_share(num_wrong: int, num: int, confidence: float) -> float:
    """Return Clopper and Pearson's upper bound of a share of which `num_wrong` of `num` were seen:
    the share at which so few are as improbable as the confidence allows."""
    if num_wrong >= num:
        return 1.0
    counts = range(num_wrong + 1)
    log_ways = [lgamma(num + 1) - lgamma(k + 1) - lgamma(num - k + 1) for k in counts]

    def probability_of_so_few(share: float) -> float:
        logs = zip(counts, log_ways, strict=True)
        return sum(exp(ways + k * log(share) + (num - k) * log1p(-share)) for k, ways in logs)

    low, high = num_wrong / num, 1.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        if probability_of_so_few(middle) > 1.0 - confidence:
            low = middle
        else:
            high = middle
    return high


@dataclass(frozen=True, eq=False)
class WorstAnswers:
    """Hold, for each piece of one condition, the highest probability of a wrong answer, -1 if there
    is none."""

    worst: Float[np.ndarray, " n"]

    @staticmethod
    def from_numbers(numbers: Sequence[int], wrong: Sequence[float]) -> WorstAnswers:
        """Return the pieces of images. `numbers` are those of their pieces, `wrong` the probability
        of an answer that is wrong, else -1."""
        groups = groupby(sorted(zip(numbers, wrong, strict=True)), key=lambda pair: pair[0])
        return WorstAnswers(
            np.array([max(probability for _, probability in group) for _, group in groups], float)
        )

    def num_wrong(self, min_probability: float) -> int:
        """Return how many pieces hold a wrong answer at a threshold of the probability."""
        return int(np.count_nonzero(self.worst >= min_probability))

    def bound(self, min_probability: float, confidence: float) -> float:
        """Return the upper bound of the share of wrong pieces at a threshold."""
        return max_share(self.num_wrong(min_probability), len(self.worst), confidence)

    def find_threshold(self, lowest: float, limit: float, confidence: float) -> float | None:
        """Return the least threshold that keeps the limit of the wrong share. If the pieces are too
        few for the limit, none of them may be wrong. None: only a threshold above 1 does."""
        limit = max(limit, max_share(0, len(self.worst), confidence))
        for threshold in [lowest, *np.nextafter(np.unique(self.worst), 2.0).tolist()]:
            is_kept = self.bound(threshold, confidence) <= limit
            if threshold >= lowest and is_kept:
                return threshold if threshold <= 1.0 else None
        return None


@dataclass(frozen=True, eq=False)
class CertifiedAnswers:
    """Hold the answers of one condition. `pieces` are the numbers of their independent pieces."""

    name: str
    kind: ConditionKind
    has_truth: bool
    answers: list[EvaluatedQuery]
    pieces: list[int]

    def wrong_probabilities(self) -> list[float]:
        """Return the probability of each wrong answer, -1 for each other image."""
        return [_probability(answer) if is_wrong(answer) else -1.0 for answer in self.answers]

    def facts(self, min_probability: float, confidence: float) -> CertifiedCondition:
        """Return the figures at a threshold of the probability."""
        wrong, num_pieces = self.wrong_probabilities(), len(set(self.pieces))
        num_wrong_pieces = WorstAnswers.from_numbers(self.pieces, wrong).num_wrong(min_probability)
        given = [answer for answer in self.answers if _probability(answer) >= min_probability]
        return CertifiedCondition(
            self.name,
            self.kind,
            self.has_truth,
            len(self.answers),
            num_pieces,
            len(given),
            sum(probability >= min_probability for probability in wrong) if self.has_truth else 0,
            num_wrong_pieces if self.has_truth else 0,
            max_share(num_wrong_pieces, num_pieces, confidence) if self.has_truth else None,
            sum(
                answer.is_inside_ellipsoid
                for answer in given
                if self.has_truth and not is_wrong(answer)
            ),
            _median_ms(given),
            _median_ms([answer for answer in self.answers if not answer.result.localized]),
        )


def derive_certificate(
    conditions: Sequence[CertifiedAnswers],
    config: LocalizerConfig,
    max_wrong_share: float,
    is_applied: bool,
    group_by: Sequence[GroupKind] = (),
) -> Certificate:
    """Return the certificate that follows from the answers, of map version 0.

    Images of the place and others are bounded apart, because their shares depend on the user. So
    each bound has half of the error probability.
    """
    known = [condition for condition in conditions if condition.has_truth]
    walks = [condition for condition in known if condition.kind == "walk"]
    others = [condition for condition in known if condition.kind != "walk"]
    groups = [_collect_pieces(some) for some in (walks, others) if some]
    confidence = 1.0 - (1.0 - CONFIDENCE) / max(len(groups), 1)
    limits = config.evidence.min_probability, max_wrong_share, confidence
    found = [group.find_threshold(*limits) for group in groups]
    threshold = None if None in found else max([limits[0], *(one or 0.0 for one in found)])
    level = limits[0] if threshold is None else threshold
    right = [
        _probability(answer)
        for condition in known
        for answer in condition.answers
        if answer.is_right
    ]
    applied = level if is_applied else 0.0
    settings, default = to_builtins(config), to_builtins(LocalizerConfig())
    return Certificate(
        map_version=0,
        program=version("topoloc"),
        date=today(),
        settings={key: value for key, value in settings.items() if value != default[key]},
        cameras=_describe_cameras(conditions),
        confidence=CONFIDENCE,
        max_wrong_share=max((one.bound(applied, confidence) for one in groups), default=None),
        requested_share=max_wrong_share,
        min_probability=threshold,
        lost_share=float(np.mean(np.array(right) < level)) if right else 0.0,
        is_applied=is_applied,
        conditions=[condition.facts(applied, confidence) for condition in conditions],
        threshold_wrong_share=max((one.bound(level, confidence) for one in groups), default=None),
        quarters=Evaluation(
            [a for one in walks for a in one.answers if _probability(a) >= applied]
        ).quarters,
        groups=[
            _derive_group(walks, by, bounds, (limits[0], max_wrong_share), applied)
            for by in group_by
            for bounds in pairwise(GROUP_BOUNDS[by])
        ],
    )


def _derive_group(
    walks: Sequence[CertifiedAnswers],
    by: GroupKind,
    bounds: tuple[float, float],
    limits: tuple[float, float],
    applied: float,
) -> CertifiedGroup:
    """Return the promise about images of walks with a difficulty within bounds. `limits` are the
    least threshold and the requested share, `applied` is the map's threshold."""

    def is_member(answer: EvaluatedQuery) -> bool:
        return bounds[0] <= answer.difficulty(by) < bounds[1]

    pieces = _collect_pieces(walks, is_member)
    answers = [answer for walk in walks for answer in walk.answers if is_member(answer)]
    given = [answer for answer in answers if _probability(answer) >= applied]
    threshold = pieces.find_threshold(*limits, CONFIDENCE) if answers else None
    return CertifiedGroup(
        by=by,
        low=bounds[0],
        high=bounds[1] if math.isfinite(bounds[1]) else None,
        num_images=len(answers),
        num_pieces=len(pieces.worst),
        num_localized=len(given),
        num_wrong=sum(map(is_wrong, given)),
        max_wrong_share=pieces.bound(applied, CONFIDENCE) if answers else None,
        min_probability=threshold,
        threshold_wrong_share=None if threshold is None else pieces.bound(threshold, CONFIDENCE),
    )


def _collect_pieces(
    conditions: Sequence[CertifiedAnswers],
    is_member: Callable[[EvaluatedQuery], bool] = lambda _: True,
) -> WorstAnswers:
    """Return the pieces of several conditions, of those answers alone that are members."""
    numbers, wrong = list[int](), list[float]()
    for row, condition in enumerate(conditions):
        members = [is_member(answer) for answer in condition.answers]
        numbers += [row * 10**6 + number for number in compress(condition.pieces, members)]
        wrong += compress(condition.wrong_probabilities(), members)
    return WorstAnswers.from_numbers(numbers, wrong)


def _describe_cameras(conditions: Sequence[CertifiedAnswers]) -> list[str]:
    cameras = [one.camera for condition in conditions for one in condition.answers if one.camera]
    return [
        f"{camera.width}x{camera.height}, {camera.model}, f {camera.fx:.0f} px"
        for camera in dict.fromkeys(cameras)
    ]


def is_wrong(answer: EvaluatedQuery) -> bool:
    """Return whether an answer has a pose beyond 0.25 m or 2 degrees, or of another place."""
    return answer.result.localized and not answer.is_right


def find_pieces(
    topomap: TopoMetricMap, answers: Sequence[EvaluatedQuery], by_pose: bool
) -> list[int]:
    """Return the number of the independent piece of each image."""
    config = topomap.config
    poses = [answer.world_from_cam for answer in answers if answer.world_from_cam is not None]
    if by_pose and len(poses) == len(answers):
        return pieces_by_pose(poses, config.d_thresh, config.lambda_rot).tolist()
    read = [answer.read_image for answer in answers]
    looks = [thumbnail(to_grey(read_image())) for read_image in read if read_image is not None]
    return pieces_by_look(np.array(looks)).tolist()


def _probability(answer: EvaluatedQuery) -> float:
    """Return the probability of a pose, -1 for a refusal."""
    return answer.result.probability if isinstance(answer.result, Localization) else -1.0


def _median_ms(answers: Sequence[EvaluatedQuery]) -> float | None:
    times = [answer.result.times_ms["total"] for answer in answers]
    return float(np.median(times)) if times else None
