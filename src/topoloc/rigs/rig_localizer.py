"""Localize a rig: each camera alone, with the place that a sure one gives, then all together.

A single camera is a rig of one: its pose and probability are those of `Localizer`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from jaxtyping import Float

from topoloc.errors import QueryError
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import Localizer
from topoloc.localization.query import Deadline, QueryImage, camera_of
from topoloc.localization.result import Localization, NotLocalized
from topoloc.localization.search import Trace
from topoloc.recordings.frame import Image
from topoloc.rigs.pose_fusion import PoseEstimate, RigHypothesis, fuse_poses, weigh_poses
from topoloc.rigs.rig import Rig
from topoloc.rigs.rig_result import RigLocalization, RigNotLocalized

_LEAD = math.exp(2.0)  # least ratio of the probability to that of another pose, as for one image
_Results = dict[str, Localization | NotLocalized]


class RigLocalizer:
    """Localize the images of a rig in a map or an atlas.

    The first camera whose pose is sure gives a prior to the others, which makes them quick. A prior
    chooses nodes only; a camera's pose needs the same evidence as without. If no camera confirms
    that pose, the others are searched without it, so that cameras that contradict each other are
    found.

    Raises MapError: the map has no scale, but mountings are in metres.
    """

    def __init__(self, localizer: Localizer, rig: Rig) -> None:
        if "" in localizer.tile_ids:  # a map; tiles of an atlas have a scale
            localizer.topomap.require_scale("a rig")
        self.localizer, self.rig = localizer, rig

    def localize(
        self, images: Mapping[str, Image], max_ms: float | None = None
    ) -> RigLocalization | RigNotLocalized:
        """Estimate the pose of the rig from images of one instant, by the names of their cameras.
        Images may be missing.

        Args:
            max_ms: time limit for all cameras, milliseconds.

        Raises:
            QueryError: there is no image, one of an unknown camera, or one of another size than its
                camera's.
        """
        unknown = sorted(images.keys() - self.rig.cameras.keys())
        if unknown or not images:
            cameras = ", ".join(self.rig.cameras)
            fault = f"no camera of the rig is named {unknown[0]}" if unknown else "no image"
            raise QueryError(f"{fault}; its cameras are {cameras}")
        limit = self.localizer.config.max_ms if max_ms is None else max_ms
        deadline = Deadline.from_limit(limit)
        seen = {name: images[name] for name in self.rig.cameras if name in images}
        tried = dict[str, list[PoseEstimate]]()
        results = self._localize_each(seen, deadline, tried)
        estimates = [one for name, of in results.items() for one in self._estimates(name, of)]
        left_out = {name: "its image is uniform" for name, of in seen.items() if np.std(of) < 2.0}
        refused = [
            one
            for name, of in tried.items()
            for one in of
            if not results[name].localized and name not in left_out
        ]
        ranked = weigh_poses(estimates, refused)
        if len(ranked) > 1 and (swap := self._find_swap(estimates, refused, ranked[0])):
            ranked, swapped = swap
            left_out |= swapped
        return self._decide(results, ranked, left_out)

    def _localize_each(
        self,
        images: Mapping[str, Image],
        deadline: Deadline | None,
        tried: dict[str, list[PoseEstimate]],
    ) -> _Results:
        sure = 0.95  # least probability of a pose that is the prior of other cameras
        queries = {name: self._query(name, image) for name, image in images.items()}
        results, near_leader, leader = _Results(), list[str](), None
        for name in self._order(queries, sure):
            results[name] = self._localize_one(name, queries[name], leader, deadline, tried)
            if leader is not None:
                near_leader.append(name)
                continue
            found = self._estimates(name, results[name])
            leader = next((one for one in found if one.probability >= sure), None)
        results = {name: results[name] for name in images}
        if leader is None:
            return results
        confirmed = any(
            one.agrees(leader)
            for name, of in results.items()
            if name != leader.camera
            for one in (*self._estimates(name, of), *tried.get(name, ()))
        )
        for name in () if confirmed else near_leader:
            # of three cameras, two outvote one: it is worth the time of a full search
            is_worth = len(images) > 2 or self._is_known(queries[name])
            if not results[name].localized and is_worth:
                results[name] = self._localize_one(name, queries[name], None, deadline, tried)
        return results

    def _query(self, name: str, image: Image) -> QueryImage:
        """Return the image with its camera, which caches its features."""
        try:
            return QueryImage(image, camera_of(image, self.rig.cameras[name].camera))
        except QueryError as error:
            raise QueryError(f"{name}: {error}") from None

    def _order(self, queries: Mapping[str, QueryImage], sure: float) -> list[str]:
        """Return the cameras, first the one whose first hypothesis is sure: its pose makes the
        others quick, and a camera that sees nothing known is slow alone."""
        for name in queries if len(queries) > 1 else ():
            if self._is_known(queries[name], sure):
                return sorted(queries, key=lambda other: other != name)
        return list(queries)

    def _is_known(self, query: QueryImage, least: float = 0.0) -> bool:
        """Return whether the first hypothesis is a pose, of this probability or more."""
        first = self.localizer.localize_query(query, max_ms=0.0)[0]
        return isinstance(first, Localization) and first.probability >= least

    def _localize_one(
        self,
        name: str,
        query: QueryImage,
        near: PoseEstimate | None,
        deadline: Deadline | None,
        tried: dict[str, list[PoseEstimate]],
    ) -> Localization | NotLocalized:
        """Localize an image, and add the poses that it suggested to those `tried`."""
        prior, tile, trace = None, None, Trace()
        if near is not None:
            prior, tile = near.world_from_rig @ self.rig.cameras[name].rig_from_cam, near.tile
        result = self.localizer.localize_query(query, prior, deadline, trace, tile)[0]
        if tile is not None or len(self.localizer.tile_ids) == 1:  # else of any tile
            tried.setdefault(name, []).extend(
                self._estimate(name, one.world_from_cam, one.covariance, 1.0, one.probability, tile)
                for one in (proposal.hypothesis for proposal in trace.tried)
                if one is not None
            )
        return result

    def _estimates(self, name: str, result: Localization | NotLocalized) -> Iterator[PoseEstimate]:
        """Yield the poses of the rig that a camera's result allows."""
        if isinstance(result, Localization):
            covariance, tile = result.camera_covariance, result.provenance.tile
            of = result.noise_share, result.probability, tile
            yield self._estimate(name, result.world_from_cam, covariance, *of)
            return
        for one in result.alternatives:
            if one.covariance is not None:
                covariance = one.world_from_cam.inverse().transform_covariance(one.covariance)
                of = 1.0, one.probability, one.tile
                yield self._estimate(name, one.world_from_cam, covariance, *of)

    def _estimate(
        self,
        name: str,
        world_from_cam: Rigid3,
        covariance: Float[np.ndarray, "6 6"],
        noise_share: float,
        probability: float,
        tile: str | None,
    ) -> PoseEstimate:
        """Return a pose of a camera, whose covariance has its axes, as a pose of the rig."""
        mounting = self.rig.cameras[name]
        in_rig = mounting.rig_from_cam.transform_covariance(covariance + mounting.covariance)
        pose = world_from_cam @ mounting.rig_from_cam.inverse()
        return PoseEstimate(name, pose, in_rig, noise_share, probability, tile)

    def _find_swap(
        self,
        estimates: Sequence[PoseEstimate],
        refused: Sequence[PoseEstimate],
        best: RigHypothesis,
    ) -> tuple[list[RigHypothesis], dict[str, str]] | None:
        """Return the poses with the images of two cameras exchanged, if more cameras then agree,
        these two with them, and what is wrong. None if no exchange does."""
        seen = dict.fromkeys(one.camera for one in (*estimates, *refused))
        found = list[tuple[int, str, str, list[RigHypothesis]]]()
        for a, b in combinations(seen, 2):
            weighed = weigh_poses(self._exchange(estimates, a, b), self._exchange(refused, a, b))
            found.append((len(weighed[0].cameras), a, b, weighed))
        most = max((votes for votes, *_ in found), default=0)
        likeliest = [(a, b, weighed) for votes, a, b, weighed in found if votes == most]
        # two cameras alone may agree by several exchanges
        if len(likeliest) != 1 or most <= len(best.cameras):
            return None
        a, b, weighed = likeliest[0]
        if not {a, b} <= weighed[0].cameras:
            return None
        text = "its image is that of {}: swapped"
        return weighed, {a: text.format(b), b: text.format(a)}

    def _exchange(self, estimates: Sequence[PoseEstimate], a: str, b: str) -> list[PoseEstimate]:
        """Return the poses of the rig if the images of two cameras are those of each other."""
        exchanged, other = list[PoseEstimate](), {a: b, b: a}
        for one in estimates:
            if one.camera in other:
                own = self.rig.cameras[one.camera].rig_from_cam
                other_mounting = self.rig.cameras[other[one.camera]].rig_from_cam
                moved = own @ other_mounting.inverse()
                covariance = moved.inverse().transform_covariance(one.covariance)
                pose = one.world_from_rig @ moved
                one = replace(one, world_from_rig=pose, covariance=covariance)
            exchanged.append(one)
        return exchanged

    def _decide(
        self, results: _Results, ranked: Sequence[RigHypothesis], left_out: dict[str, str]
    ) -> RigLocalization | RigNotLocalized:
        if not ranked:
            reasons = [of for of in results.values() if isinstance(of, NotLocalized)]
            # the reason of the camera that came nearest to a pose
            nearest = max(reasons, key=lambda one: one.num_inliers)
            return RigNotLocalized(nearest.reason, nearest.detail, results, left_out)
        best, least = ranked[0], self.localizer.config.evidence.min_probability
        used = tuple(one.camera for one in best.estimates)
        alone = results[used[0]]
        if len(used) == 1 and isinstance(alone, NotLocalized):  # no other camera confirms it
            return RigNotLocalized(alone.reason, alone.detail, results, left_out)
        rival = ranked[1].probability if len(ranked) > 1 else 0.0
        is_outvoted = any(
            not best.outvotes(other)
            and any(results[one.camera].localized for one in other.estimates)
            for other in ranked[1:]
        )
        if is_outvoted or best.probability < max(least, _LEAD * rival):
            places = "; ".join(" and ".join(one.camera for one in of.estimates) for of in ranked)
            detail = f"the cameras show different places: {places}"
            return RigNotLocalized("ambiguous", detail, results, left_out)
        pose, covariance = fuse_poses(best.estimates)
        for other in ranked[1:]:
            for one in other.estimates:
                if one.camera not in used and isinstance(results[one.camera], Localization):
                    left_out.setdefault(one.camera, _describe_contradiction(pose, one))
        return RigLocalization(
            pose, covariance, best.probability, results, used, left_out, best.estimates[0].tile
        )


def _describe_contradiction(world_from_rig: Rigid3, other: PoseEstimate) -> str:
    shift = world_from_rig.inverse() @ other.world_from_rig
    way, degrees = float(np.linalg.norm(shift.translation)), float(np.rad2deg(shift.angle()))
    return (
        f"its pose is {way:.2f} m and {degrees:.1f} deg from that of the others: mounted otherwise,"
        " late, or of another camera"
    )
