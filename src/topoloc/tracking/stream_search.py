"""Where a picture of a stream was taken, in full: the localizer's answer, weighed against what is
believed so far."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from topoloc.geometry.rigid import Rigid3
from topoloc.localization.evidence import precision_of
from topoloc.localization.localizer import Localizer
from topoloc.localization.pose_fit import SeenPoints
from topoloc.localization.result import Localization, NotLocalized
from topoloc.tracking.pose_errors import PoseErrors, errors_of
from topoloc.tracking.pose_hypotheses import Candidate, PoseHypotheses, is_same_place
from topoloc.tracking.tracker_state import StreamPicture


@dataclass(frozen=True, eq=False)
class Expected:
    """About where the picture was taken, and what that is wrong by beside what the filter knows of
    (covariance, left, of cam_from_world).

    Who asks around there alone finds only what is there; `is_enough` where nothing else is likely.
    `is_from_walls`: nodes around do not look this way, so that they know nothing of the picture.
    """

    world_from_cam: Rigid3
    doubt: Float[np.ndarray, "6 6"]
    is_enough: bool
    is_followed: bool = False
    is_from_walls: bool = False


@dataclass(frozen=True, eq=False)
class Found:
    """A pose that the picture may have, with its probability, the points that it stands on, and
    what it is wrong by."""

    result: Localization
    seen: SeenPoints
    errors: PoseErrors
    probability: float


class StreamSearch:
    """Asks the localizer and weighs what it answers."""

    def __init__(
        self, localizer: Localizer, hypotheses: PoseHypotheses, floor_share: float
    ) -> None:
        self._localizer, self._hypotheses, self._floor_share = localizer, hypotheses, floor_share
        self._asked_at: Rigid3 | None = None  # where the last ambiguous picture was taken

    def find(self, picture: StreamPicture, expected: Expected | None) -> Found | NotLocalized:
        """What is believed of this picture, or why nothing is: around what is expected, then in all
        of the map."""
        doubt = np.zeros((6, 6)) if expected is None else expected.doubt
        refusal, found = None, list[Found]()
        if expected is not None and expected.is_enough:
            refusal, found = self._ask(picture, expected.world_from_cam)
            if refusal is not None and expected.is_followed:
                if not expected.is_from_walls:
                    self._hypotheses.weigh(picture.t_ns, [])
                return refusal
        if len(found) != 1 or not self._follows(found[0], doubt):
            refusal, found = self._everywhere(picture)
        candidates = [
            Candidate(
                one.result.world_from_cam,
                one.errors.whole + doubt,
                one.probability,
                one.result.node_id,
            )
            for one in found
        ]
        self._hypotheses.weigh(
            picture.t_ns, candidates, picture.odom_from_cam, self._share_new(found)
        )
        if self._hypotheses.taken is not None:
            return found[self._hypotheses.taken]
        return refusal or refused(found[0].result)

    def _share_new(self, found: list[Found]) -> float:
        """How much of what a picture says that is not sure is new since the one before that was
        not."""
        best, before, config = self._hypotheses.best, self._asked_at, self._hypotheses.config
        if not found or best is None or found[0].probability >= 1.0 - config.miss:
            return 1.0
        self._asked_at = best.world_from_cam
        if before is None or not self._hypotheses.continues:
            return 1.0
        moved = before.inverse() @ best.world_from_cam
        depth = float(np.median([one.errors.depth for one in found]))
        way = float(np.linalg.norm(moved.translation)) / depth + moved.angle()
        return 1.0 - math.exp(-way / (config.renewal if len(found) > 1 else config.renewal_alone))

    def _everywhere(self, picture: StreamPicture) -> tuple[NotLocalized | None, list[Found]]:
        """As `_ask` in all of the map. Where that does not settle it, also around each hypothesis
        that the answer leaves out: of many poses that look alike a search finds some. What it left
        out is at most as likely as the others are in the mean.
        """
        refusal, found = self._ask(picture, None)
        if refusal is None:
            return refusal, found
        missed: list[Found] = []
        for hypothesis in self._hypotheses.alternatives()[: self._hypotheses.config.max_asked]:
            if not _is_among(hypothesis.world_from_cam, [*found, *missed]):
                around = self._ask(picture, hypothesis.world_from_cam)[1]
                missed += [
                    one
                    for one in around
                    if not _is_among(one.result.world_from_cam, [*found, *missed])
                ]
        whole = len(found) + len(missed)
        found = [replace(one, probability=one.probability * len(found) / whole) for one in found]
        return refusal, found + [
            replace(one, probability=one.probability / whole) for one in missed
        ]

    def _follows(self, found: Found, doubt: Float[np.ndarray, "6 6"]) -> bool:
        best = self._hypotheses.best
        return best is not None and self._hypotheses.follows(
            best, found.result.world_from_cam, found.errors.whole + doubt
        )

    def _ask(
        self, picture: StreamPicture, near: Rigid3 | None
    ) -> tuple[NotLocalized | None, list[Found]]:
        """The poses that the picture may have: one, the alternatives of an ambiguous one, or none
        and why."""
        result, named = self._localizer.localize_near(picture.image, picture.camera, near)
        if isinstance(result, NotLocalized):
            return result, [self._found(one, seen, one.probability) for one, seen in named]
        return None, [
            self._found(one, seen, min(_of_place(one), 1.0 - self._hypotheses.config.miss))
            for one, seen in named
        ]

    def _found(self, result: Localization, seen: SeenPoints, probability: float) -> Found:
        depth = float(np.median(result.world_from_cam.inverse().apply(seen.points_world)[:, 2]))
        return Found(result, seen, errors_of(result, depth, self._floor_share), probability)


def _of_place(found: Localization) -> float:
    """The probability of the place: that of the answer is also that of being precise, which says
    nothing of other places."""
    return (
        found.probability
        if found.evidence is None
        else min(found.probability / precision_of(found.evidence), 1.0)
    )


def _is_among(world_from_cam: Rigid3, found: list[Found]) -> bool:
    return any(is_same_place(one.result.world_from_cam, world_from_cam) for one in found)


def refused(found: Localization) -> NotLocalized:
    """A pose that the motion does not allow for."""
    return NotLocalized(
        "jump",
        found.candidates,
        found.num_matches,
        found.num_inliers,
        found.times_ms,
        provenance=found.provenance,
    )
