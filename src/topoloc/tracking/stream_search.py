"""Where a picture of a stream was taken, in full: the localizer's answer, weighed against what is believed so far."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization, NotLocalized
from topoloc.localization.seen_points import SeenPoints
from topoloc.tracking.pose_errors import PoseErrors, errors_of
from topoloc.tracking.pose_hypotheses import Candidate, PoseHypotheses
from topoloc.tracking.tracker_state import StreamPicture


@dataclass(frozen=True, eq=False)
class Found:
    """A picture localized as the heaviest hypothesis has it."""

    result: Localization
    seen: SeenPoints
    errors: PoseErrors


class StreamSearch:
    """Asks the localizer and weighs what it answers."""

    def __init__(self, localizer: Localizer, hypotheses: PoseHypotheses, floor_share: float) -> None:
        self._localizer, self._hypotheses, self._floor_share = localizer, hypotheses, floor_share

    def find(self, picture: StreamPicture, near: Rigid3 | None, doubt: Float[np.ndarray, "6 6"], is_followed: bool) -> Found | NotLocalized:
        """What is believed of this picture, or why nothing is.

        Around `near` alone a pose that follows is enough. Where it does not, all that the map has is asked: who knows where to look finds only
        what is there. `doubt` is the covariance of the prediction beside that of the filter; with followed points a failure costs no more time.
        """
        found = self._ask(picture, near)
        if near is not None and not (isinstance(found, NotLocalized) and is_followed) and not self._follows(found, doubt):
            found = self._ask(picture, None)
        self._hypotheses.weigh(picture.t_ns, self._candidates(found, doubt), picture.odom_from_cam)
        if self._hypotheses.taken is None:
            return refused(found.result) if isinstance(found, Found) else found
        if isinstance(found, Found):
            return found
        around = self._ask(picture, self._hypotheses.best.world_from_cam)
        return around if self._follows(around, np.zeros((6, 6))) else found

    def _ask(self, picture: StreamPicture, near: Rigid3 | None) -> Found | NotLocalized:
        result, seen = self._localizer.localize_near(picture.image, picture.camera, near)
        if isinstance(result, NotLocalized):
            return result
        assert seen is not None, "points are seen where a pose was found"
        depth = float(np.median(result.world_from_cam.inverse().apply(seen.points_world)[:, 2]))
        return Found(result, seen, errors_of(result, depth, self._floor_share))

    def _follows(self, found: Found | NotLocalized, doubt: Float[np.ndarray, "6 6"]) -> bool:
        if isinstance(found, NotLocalized) or not self._hypotheses.is_alive:
            return False
        return self._hypotheses.follows(self._hypotheses.best, found.result.world_from_cam, found.errors.whole + doubt)

    def _candidates(self, found: Found | NotLocalized, doubt: Float[np.ndarray, "6 6"]) -> list[Candidate]:
        """A localization stands alone: its probability is also that of being precise, which is none of other places."""
        config = self._hypotheses.config
        if isinstance(found, Found):
            return [Candidate(found.result.world_from_cam, found.errors.whole + doubt, 1.0 - config.miss, found.result.node_id)]
        covariance = config.alternative_sigma**2 * np.eye(6) + doubt
        return [Candidate(one.world_from_cam, covariance, one.probability, one.node_id) for one in found.alternatives]


def refused(found: Localization) -> NotLocalized:
    """A pose that the motion does not allow for."""
    return NotLocalized("jump", found.candidates, found.num_matches, found.num_inliers, found.times_ms)
