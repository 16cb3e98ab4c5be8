"""Refine a reported pose with all that the map knows around it.

The verdict needs few nodes and one feature type. Once the place is certain, points of more nodes
and of all feature types are matched near their predicted pixels. This is safe only for a pose that
is accurate to a few pixels: within a small radius few matches are right by chance.

Each match is then aligned by correlation (`patch_alignment.py`). A key point lies one to three
pixels off the described point, an aligned patch a third of a pixel. Matches that do not correlate
are dropped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from topoloc.geometry.absolute_pose import (
    AbsolutePose,
    compute_variance_inflation,
    refine_absolute_pose,
)
from topoloc.geometry.camera import Camera, UncalibratedCamera
from topoloc.geometry.rigid import Rigid3, inverse_covariance
from topoloc.localization.answer import Answer, Finding
from topoloc.localization.exact.patch_alignment import (
    LastStepWeights,
    PreciseMatches,
    align,
    load_last_step_weights,
)
from topoloc.localization.guided import match_guided
from topoloc.localization.map_query import MapQuery
from topoloc.localization.pose_fit import LocalMap
from topoloc.localization.search import Search


@dataclass(frozen=True, eq=False)
class PreciseFit:
    """Hold a pose and the matches that it was fitted to, in the reduced image."""

    pose: AbsolutePose
    matches: PreciseMatches
    is_aligned: bool = False


def _can_refine(searches: Sequence[Search], weights: LastStepWeights) -> bool:
    """Return whether the last step improves poses of this query.

    An unknown focal length would have to follow. In a map with strongly correlated errors, such as
    those of a wrong calibration, the nearest nodes are best, because these errors cancel out there.
    """
    first = searches[0]
    return (
        first.config.exactness == "best"
        and first.config.guided.num_nodes > 0
        and first.correlated_error_share <= weights.max_correlated_error_share
        and not isinstance(first.query.input_camera, UncalibratedCamera)
        and not first.query.deadline.is_past
        and bool(first.query.grey.any())  # not so if only features are known
    )


def refine_answer(query: MapQuery, answer: Answer) -> Finding | None:
    """Refine the pose of an answer with all nodes around it, unless too few points agree.

    Nodes near a pose from virtual views show something else. A calibration in doubt and a rotation
    during a rolling shutter would have to be estimated with the pose.
    """
    pose, best, searches = answer.pose, answer.best, query.searches
    weights = load_last_step_weights()
    if (
        pose is None
        or best is None
        or not best.evidence.is_of_nodes
        or pose.calibration_doubt is not None
        or pose.frame_rotation_deg is not None
        or not _can_refine(searches, weights)
    ):
        return None
    first = searches[0]
    # the feature type that found the pose comes first
    ordered = sorted(searches, key=lambda one: one.map.kind.name != pose.provenance.features)
    with first.query.clock.stage("last_step"):
        fit = refine_precisely(ordered, pose.world_from_cam.inverse(), weights)
        if fit is None:
            return None
        seen = fit.matches.select(np.flatnonzero(fit.pose.inliers))
        parts = seen.points_img.astype(np.float64), seen.points_world, seen.covariances
        cam_from_world = fit.pose.cam_from_world
        inflation = compute_variance_inflation(
            *parts, first.query.camera, cam_from_world, seen.sigmas_px
        )
    noise = inflation**2 * fit.pose.covariance
    before = inverse_covariance(pose.world_from_cam, pose.covariance)
    shared = (1.0 - pose.noise_share) * before  # key points share the errors of the verdict's
    if fit.is_aligned:
        # the less the nodes contradict each other, the more of their errors average out
        shared *= min(1.0, weights.shared_error_slope * first.correlated_error_share)
        shared += np.dot(weights.slow_errors, (1.0, 1.0 / len(seen))) * noise
    facts = {
        "world_from_cam": cam_from_world.inverse(),
        "covariance": inverse_covariance(cam_from_world, noise + shared),
        "noise_share": float(np.trace(noise[:3, :3]) / np.trace((noise + shared)[:3, :3])),
    }
    points, text = seen.to_image_scale(first.query.scale), f"refined with {len(seen)} points"
    return Finding("exact pose", text, facts=facts, points=points)


def refine_precisely(
    searches: Sequence[Search], cam_from_world: Rigid3, weights: LastStepWeights
) -> PreciseFit | None:
    """Refine a pose that is accurate to some pixels. None if too few points agree."""
    around = Surroundings.at_pose(searches, cam_from_world, weights)
    fit = around.refine_by_key_points(cam_from_world)
    if fit is None:
        return None
    inliers = fit.matches.select(np.flatnonzero(fit.pose.inliers))
    chosen, aligned = _spread(inliers, around.camera, weights.max_aligned), fit
    templates = searches[0].templates(chosen.node_ids)
    for reach_px in weights.reaches_px:
        moved = align(
            searches[0].query.grey,
            around.camera,
            chosen,
            templates,
            aligned.pose.cam_from_world,
            reach_px,
            weights,
        )
        better = around.fit(moved, aligned.pose.cam_from_world, weights.max_aligned_error_px)
        if better is None or np.count_nonzero(better.pose.inliers) < weights.min_aligned:
            return fit
        aligned = better
    return replace(aligned, is_aligned=True)


def _spread(matches: PreciseMatches, camera: Camera, max_number: int) -> PreciseMatches:
    """Return at most `max_number` matches: in turn the most similar one of each image cell."""
    if len(matches) <= max_number:
        return matches
    num_columns = 16
    columns, rows = (matches.points_img / np.float32(camera.width / num_columns)).astype(np.int64).T
    cells = rows * num_columns + columns
    order = np.lexsort((-matches.similarities, cells))
    rank = np.arange(len(order)) - np.searchsorted(cells[order], cells[order])
    return matches.select(np.sort(order[np.argsort(rank, kind="stable")[:max_number]]))


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Hold the points of the nodes near a pose, for each search of the query."""

    searches: Sequence[Search]
    maps: Sequence[LocalMap]
    weights: LastStepWeights

    @staticmethod
    def at_pose(
        searches: Sequence[Search], cam_from_world: Rigid3, weights: LastStepWeights
    ) -> Surroundings:
        """Return the surroundings of a pose."""
        rows = searches[0].map.nearest(cam_from_world.inverse(), weights.num_nodes)
        return Surroundings(searches, [one.map.local_map(rows) for one in searches], weights)

    @property
    def camera(self) -> Camera:
        """Return the camera of the query."""
        return self.searches[0].query.camera

    def refine_by_key_points(self, cam_from_world: Rigid3) -> PreciseFit | None:
        """Refine the pose in two rounds: with the first search, then with all and tighter."""
        fit, num_searches = None, (1, len(self.searches))
        for number, radius_px, max_error_px in zip(
            num_searches, self.weights.radii_px, self.weights.max_errors_px, strict=True
        ):
            matches = self.match(cam_from_world, radius_px, number)
            fit = self.fit(matches, cam_from_world, max_error_px)
            if fit is None:
                return None
            cam_from_world = fit.pose.cam_from_world
        return fit

    def match(self, cam_from_world: Rigid3, radius_px: float, num_searches: int) -> PreciseMatches:
        """Match the key points of the first searches within a radius of the predicted pixels."""
        parts = list[PreciseMatches]()
        for search, points in zip(self.searches[:num_searches], self.maps, strict=False):
            features = search.query.features
            config = replace(search.config.guided, radius_px=radius_px)
            matches = match_guided(features, points, cam_from_world, self.camera, config)
            rows = matches.train_idx
            parts.append(
                PreciseMatches(
                    features.points_img[matches.query_idx],
                    points.points_world[rows],
                    points.covariances[rows],
                    points.node_ids[rows],
                    1.0 - np.square(matches.distances.astype(np.float64)) / 2.0,
                    np.full(len(rows), self.weights.key_point_sigma_px),
                )
            )
        columns = ([getattr(part, one.name) for part in parts] for one in fields(PreciseMatches))
        return PreciseMatches(*(np.concatenate(column) for column in columns))

    def fit(self, matches: PreciseMatches, start: Rigid3, max_error_px: float) -> PreciseFit | None:
        """Fit the pose to matches. None if too few agree."""
        pose = refine_absolute_pose(
            matches.points_img.astype(np.float64),
            matches.points_world,
            matches.covariances,
            matches.sigmas_px,
            self.camera,
            start,
            max_error_px * self.camera.radius_scale,
        )
        if pose is None or np.count_nonzero(pose.inliers) < self.weights.min_matches:
            return None
        return PreciseFit(pose, matches)
