"""Localize a rig: each camera alone, with the place that a sure one gives, then all together.

A single camera is a rig of one: its pose and probability are those of `Localizer`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from topoloc.errors import QueryError
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import Localizer
from topoloc.localization.query import Deadline
from topoloc.localization.result import Localization, NotLocalized
from topoloc.recordings.frame import Image
from topoloc.rigs.pose_fusion import PoseEstimate, RigHypothesis, fuse_poses, weigh_poses
from topoloc.rigs.rig import Rig, RigCamera
from topoloc.rigs.rig_result import RigLocalization, RigNotLocalized

_LEAD = math.exp(2.0)  # least ratio of the probability to that of another pose, as for one image
_Results = dict[str, Localization | NotLocalized]


class RigLocalizer:
    """Localize the images of a rig in a map or an atlas.

    The first camera whose pose is sure gives a prior to the others, which makes them quick. A prior
    chooses nodes only; a camera's pose needs the same evidence as without. If no camera confirms
    that pose, the others are searched without it, so that cameras that contradict each other are
    found.
    """

    def __init__(self, localizer: Localizer, rig: Rig) -> None:
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
        results = self._localize_each(seen, deadline)
        estimates = [one for name, of in results.items() for one in self._estimates(name, of)]
        left_out = {name: "its image is uniform" for name, of in seen.items() if np.std(of) < 2.0}
        ranked = weigh_poses(estimates)
        if len(ranked) > 1 and (swap := self._find_swap(results, ranked)):
            ranked, swapped = swap
            left_out |= swapped
        return self._decide(results, ranked, left_out)

    def _localize_each(self, images: Mapping[str, Image], deadline: Deadline | None) -> _Results:
        sure = 0.95  # least probability of a pose that is the prior of other cameras
        results, near_leader, leader = _Results(), list[str](), None
        for name, image in images.items():
            results[name] = self._localize_one(name, image, leader, deadline)
            if leader is not None:
                near_leader.append(name)
                continue
            found = self._estimates(name, results[name])
            leader = next((one for one in found if one.probability >= sure), None)
        if leader is None:
            return results
        confirmed = any(
            one.agrees(leader)
            for name, of in results.items()
            if name != leader.camera
            for one in self._estimates(name, of)
        )
        for name in () if confirmed else near_leader:
            if not results[name].localized:
                results[name] = self._localize_one(name, images[name], None, deadline)
        return results

    def _localize_one(
        self, name: str, image: Image, near: PoseEstimate | None, deadline: Deadline | None
    ) -> Localization | NotLocalized:
        of, prior = self.rig.cameras[name], None
        if near is not None:
            prior = near.world_from_rig @ of.rig_from_cam
        tile = None if near is None else near.tile
        try:
            return self.localizer.localize(image, of.camera, prior, deadline, tile_id=tile)
        except QueryError as error:
            raise QueryError(f"{name}: {error}") from None

    def _estimates(
        self, name: str, result: Localization | NotLocalized, mounting: RigCamera | None = None
    ) -> Iterator[PoseEstimate]:
        """Yield the poses of the rig that a camera's result allows."""
        rig_from_cam = (mounting or self.rig.cameras[name]).rig_from_cam
        cam_from_rig = rig_from_cam.inverse()
        if isinstance(result, Localization):
            covariance, tile = result.camera_covariance, result.provenance.tile
            found = [(result.world_from_cam, covariance, result.probability, tile)]
            share = result.noise_share
        else:
            share = 1.0
            found = [
                (
                    one.world_from_cam,
                    one.world_from_cam.inverse().transform_covariance(one.covariance),
                    one.probability,
                    one.tile,
                )
                for one in result.alternatives
                if one.covariance is not None
            ]
        for world_from_cam, covariance, probability, tile in found:
            in_rig = rig_from_cam.transform_covariance(covariance)
            pose = world_from_cam @ cam_from_rig
            yield PoseEstimate(name, pose, in_rig, share, probability, tile)

    def _find_swap(
        self, results: _Results, ranked: Sequence[RigHypothesis]
    ) -> tuple[list[RigHypothesis], dict[str, str]] | None:
        """Return the poses with the images of two cameras exchanged, if all localized cameras then
        agree, and what is wrong. None if no exchange does."""
        localized = [name for name, one in results.items() if isinstance(one, Localization)]
        for a, b in combinations(localized, 2):
            other = {a: b, b: a}
            weighed = weigh_poses(
                [
                    replace(one, camera=name)
                    for name, of in results.items()
                    for one in self._estimates(name, of, self.rig.cameras[other.get(name, name)])
                ]
            )
            if len(weighed) == 1 < len(ranked):
                text = "its image is that of {}: swapped"
                return weighed, {a: text.format(b), b: text.format(a)}
        return None

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
        if best.probability < max(least, _LEAD * rival):
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
