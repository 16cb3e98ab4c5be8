"""Refine a reported pose with the images of the nodes around it.

First the key points of the query are matched with points of more nodes than the verdict needed,
near their predicted pixels. This corrects a pose that is off by several pixels.

Then points in view are aligned by correlation with the images of their nodes
(`patch_alignment.py`), whether or not the query has a key point there. A key point lies one to
three pixels off the described point, an aligned patch a third of a pixel. So the query needs no
features beyond those of the verdict.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32, Int

from topoloc.geometry.absolute_pose import (
    AbsolutePose,
    compute_variance_inflation,
    refine_absolute_pose,
)
from topoloc.geometry.camera import Camera, UncalibratedCamera
from topoloc.geometry.pose_matches import cells_of
from topoloc.geometry.rigid import Rigid3, inverse_covariance
from topoloc.localization.answer import Answer, Finding
from topoloc.localization.exact.appearance import find_shown_points
from topoloc.localization.exact.patch_alignment import (
    LastStepWeights,
    PreciseMatches,
    align,
    load_last_step_weights,
)
from topoloc.localization.guided import match_guided, select_visible_points
from topoloc.localization.map_query import MapQuery
from topoloc.localization.pose_fit import LocalMap
from topoloc.localization.search import Search


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
        found = refine_precisely(ordered, pose.world_from_cam.inverse(), weights)
        if found is None:
            return None
        fit, aligned = found
        seen, cam_from_world = aligned.select(np.flatnonzero(fit.inliers)), fit.cam_from_world
        noise = _clustered_noise(fit, seen, first.query.camera)
        overlap = len(seen) / _num_apart(first, seen, cam_from_world, weights.patch_px)
    before = inverse_covariance(pose.world_from_cam, pose.covariance)
    # the less the nodes contradict each other, the more of their errors average out
    share = min(1.0, weights.shared_error_slope * first.correlated_error_share)
    shared = share * (1.0 - pose.noise_share) * before
    shared += max(0.0, weights.overlap_noise * overlap - 1.0) * noise
    facts = {
        "world_from_cam": cam_from_world.inverse(),
        "covariance": inverse_covariance(cam_from_world, noise + shared),
        "noise_share": float(np.trace(noise[:3, :3]) / np.trace((noise + shared)[:3, :3])),
    }
    points, text = seen.to_image_scale(first.query.scale), f"refined with {len(seen)} points"
    return Finding("exact pose", text, facts=facts, points=points)


def _clustered_noise(
    fit: AbsolutePose, seen: PreciseMatches, camera: Camera
) -> Float[np.ndarray, "6 6"]:
    """Return the covariance of a fit, inflated by errors that its inliers share within parts of
    the area that they cover, which may be a door far ahead."""
    first, last = np.quantile(seen.points_img, (0.05, 0.95), axis=0)
    width, height = np.ceil(last - first).astype(int).tolist()
    inflation = compute_variance_inflation(
        seen.points_img.astype(np.float64),
        seen.points_world,
        seen.covariances,
        camera,
        fit.cam_from_world,
        seen.sigmas_px,
        cells=cells_of(seen.points_img - first, width + 1, height + 1),
    )
    return inflation**2 * fit.covariance


def _num_apart(search: Search, seen: PreciseMatches, cam_from_world: Rigid3, patch_px: int) -> int:
    """Return how many patches lie side by side in the area that these cover. Others overlap them,
    and their errors are the same.

    If the nodes are farther away than the query, a patch of their images is as much larger in it.
    """
    origins = search.templates(seen.node_ids).origins
    centre = cam_from_world.inverse().translation
    of_node, of_query = (
        np.linalg.norm(seen.points_world - one, axis=1) for one in (origins, centre)
    )
    size_px = patch_px * max(1.0, float(np.median(of_node / of_query)))
    columns, rows = np.floor(seen.points_img / size_px).astype(np.int64).T
    return len(np.unique(rows * 100_000 + columns))


def refine_precisely(
    searches: Sequence[Search], cam_from_world: Rigid3, weights: LastStepWeights
) -> tuple[AbsolutePose, PreciseMatches] | None:
    """Refine a pose that is accurate to some pixels. Return it with its matches, in the reduced
    image. None if too few points agree."""
    # the features of the others are not extracted yet
    asked = [one for one in searches if one.first is not None]
    around = Surroundings.at_pose(asked, cam_from_world, weights)
    by_key_points = around.fit(around.match(cam_from_world), cam_from_world, weights.max_error_px)
    if by_key_points is not None and np.count_nonzero(by_key_points.inliers) >= weights.min_matches:
        cam_from_world = by_key_points.cam_from_world
    shown, found = around.points_in_view(cam_from_world), None
    if len(shown) < weights.min_aligned:
        return None
    templates = asked[0].templates(shown.node_ids)
    for max_number, reach_px in zip(weights.max_aligned, weights.reaches_px, strict=True):
        number = min(max_number, len(shown))
        rows = np.arange(number) * len(shown) // number
        aligned = align(
            asked[0].query.grey,
            around.camera,
            shown.select(rows),
            replace(templates, of_point=templates.of_point[rows]),
            cam_from_world,
            reach_px,
            around.growth,
            weights,
        )
        fit = around.fit(aligned, cam_from_world, weights.max_aligned_error_px)
        if fit is None or np.count_nonzero(fit.inliers) < weights.min_aligned:
            return None
        cam_from_world, found = fit.cam_from_world, (fit, aligned)
    return found


def _in_turn(pixels: Float[np.ndarray, "n 2"], camera: Camera) -> Int[np.ndarray, " n"]:
    """Return the rows of pixels in turn: the first one of each image cell, then the second."""
    num_columns = 16
    columns, rows = (pixels / (camera.width / num_columns)).astype(np.int64).T
    cells = (rows * num_columns + columns).astype(np.int16)  # sorted by digits, which is quicker
    order, ranks = np.argsort(cells, kind="stable"), np.empty(len(cells), np.int16)
    ranks[order] = np.arange(len(order)) - np.searchsorted(cells[order], cells[order])
    return np.argsort(ranks, kind="stable")


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Hold the points of the nodes near a pose, nearest first, for each search of the query."""

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

    @property
    def growth(self) -> float:
        """Return by how much of the square of its distance the variance of a node grows."""
        return min(1.0, self.searches[0].correlated_error_share / self.weights.full_growth_share)

    def match(self, cam_from_world: Rigid3) -> PreciseMatches:
        """Match key points near the predicted pixels."""
        parts = list[PreciseMatches]()
        for search, points in zip(self.searches, self.maps, strict=True):
            features = search.query.features
            config = replace(search.config.guided, radius_px=self.weights.radius_px)
            matches = match_guided(features, points, cam_from_world, self.camera, config)
            found = features.points_img[matches.query_idx]
            parts.append(self._matches(found, points, matches.train_idx))
        return PreciseMatches.concatenate(parts)

    def points_in_view(self, cam_from_world: Rigid3) -> PreciseMatches:
        """Return the points in view at their predicted pixels, in turn from each image cell those
        of the nearest node first."""
        parts = list[PreciseMatches]()
        for points in self.maps:
            rows, pixels = select_visible_points(points.points_world, cam_from_world, self.camera)
            places = pixels / [self.camera.width, self.camera.height]
            depths = cam_from_world.apply(points.points_world[rows])[:, 2]
            is_shown = find_shown_points(places, depths)
            parts.append(self._matches(pixels[is_shown].astype(np.float32), points, rows[is_shown]))
        shown = PreciseMatches.concatenate(parts)
        return shown.select(
            _in_turn(shown.points_img, self.camera)[: max(self.weights.max_aligned)]
        )

    def _matches(
        self, pixels: Float32[np.ndarray, "n 2"], points: LocalMap, rows: np.ndarray
    ) -> PreciseMatches:
        sigmas = np.full(len(rows), self.weights.key_point_sigma_px)
        parts = points.points_world[rows], points.covariances[rows], points.node_ids[rows]
        return PreciseMatches(pixels, *parts, sigmas)

    def fit(
        self, matches: PreciseMatches, start: Rigid3, max_error_px: float
    ) -> AbsolutePose | None:
        """Fit the pose to matches. None if too few agree."""
        return refine_absolute_pose(
            matches.points_img.astype(np.float64),
            matches.points_world,
            matches.covariances,
            matches.sigmas_px,
            self.camera,
            start,
            max_error_px * self.camera.radius_scale,
        )
