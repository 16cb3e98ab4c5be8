"""Propose poses from virtual views, for a return along a trajectory mapped in one direction.

This is the last source of proposals. The image's views to the left and right
(`features/virtual_views.py`) are compared with the virtual views of the map. Candidate places come
from `virtual_view_index.py`. A pose that matches of both views agree on (`upright_pose.py`) is
refined in both together (`virtual_view_matching.py`).

Walls repeat, doors above all. So the evidence also counts the key points that match here better
than anywhere else in the virtual views. Poses near nodes with the same viewing direction are
skipped, because those nodes would have found them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from topoloc.features.config import MatchingConfig
from topoloc.features.features import Matches
from topoloc.features.matching import match_features, match_pooled
from topoloc.geometry.absolute_pose import AbsolutePoseConfig
from topoloc.geometry.rigid import Rigid3
from topoloc.geometry.uncalibrated_camera import UncalibratedCamera
from topoloc.localization.belief import Hypothesis
from topoloc.localization.evidence import measure_evidence
from topoloc.localization.map_facts.correlated_errors import covariance_inflation
from topoloc.localization.pose_fit import PointMatches, PoseFit, fit_pose
from topoloc.localization.search import Proposal, Search
from topoloc.localization.walls.upright_pose import estimate_upright_pose
from topoloc.localization.walls.virtual_view_matching import (
    Sides,
    VirtualViewSearch,
    count_virtual_views,
    merge_matches,
)


@dataclass(frozen=True, eq=False, kw_only=True)
class VirtualViewProposal(Proposal):
    """Hold a pose proposal on which `num_agreeing` matches of both views with one place agree."""

    num_agreeing: int
    cam_from_world: Rigid3
    walls: VirtualViewSearch

    def refine(self) -> PoseFit | None:
        """Return the pose refined with matches of both views.

        None if too few points agree, or the pose is near the map's nodes.
        """
        walls, search, fit = self.walls, self.search, None
        cam_from_world, min_inliers = self.cam_from_world, search.config.evidence.min_inliers
        with search.query.clock.stage("walls"):
            for radius_px, max_error_px in search.config.walls.rounds:
                if _is_seen_by_nodes(search, cam_from_world):
                    return None
                is_guided = radius_px > 0.0
                found = walls.match(cam_from_world, radius_px) if is_guided else self.fit
                fit = None if found is None else _fit(walls, found, cam_from_world, max_error_px)
                if fit is None or fit.num_inliers < min_inliers:
                    return None
                cam_from_world = fit.cam_from_world
            return None if _is_seen_by_nodes(search, cam_from_world) else fit

    def score(self, final: PointMatches) -> Hypothesis | None:
        """Return the refined pose as a hypothesis. None if too few points were found."""
        min_found = 20  # minimum number of map points found at their predicted pixels
        if not isinstance(final, PoseFit) or final.num_inliers < min_found:
            return None
        with self.search.query.clock.stage("walls"):
            return _score(self, final)


def propose_virtual_views(search: Search) -> Iterator[Proposal]:
    """Generate the proposals with the most agreeing matches."""
    clear_log_odds = 2.5  # virtual views are skipped if a pose of the nodes has higher log-odds
    config, best = search.config.walls, search.best
    is_explained_by_nodes = (
        best is not None
        and best.probability >= search.config.evidence.min_probability
        and best.log_odds > clear_log_odds
    )
    if (
        is_explained_by_nodes
        or search.is_repetitive
        or config.num_places == 0
        or isinstance(search.query.input_camera, UncalibratedCamera)
        or (index := search.map.walls) is None
    ):
        return
    with search.query.clock.stage("walls"):
        walls = VirtualViewSearch.of(search, index)
        found = [
            proposal
            for place in walls.places
            if (proposal := _compare_views(walls, place)) is not None
        ]
        chosen = _select_best([_compare_again(proposal) for proposal in _select_best(found)])
    yield from chosen


def _select_best(found: list[VirtualViewProposal]) -> list[VirtualViewProposal]:
    """Return the proposals with the most agreeing matches, at distinct places."""
    num_hypotheses = 6  # maximum number of pose proposals that are refined
    kept: list[VirtualViewProposal] = []
    for proposal in sorted(found, key=lambda one: -one.num_agreeing):
        search = proposal.walls.search
        if len(kept) == num_hypotheses:
            break
        if not any(
            _are_near(search, proposal.cam_from_world, other.cam_from_world) for other in kept
        ):
            kept.append(proposal)
    return kept


def _compare_again(proposal: VirtualViewProposal) -> VirtualViewProposal:
    """Match again from the proposal's own pose, and keep the result if more matches agree.

    The candidate place was only near the pose.
    """
    again = _compare_views(proposal.walls, proposal.cam_from_world.inverse())
    return again if again is not None and again.num_agreeing > proposal.num_agreeing else proposal


def _compare_views(walls: VirtualViewSearch, place: Rigid3) -> VirtualViewProposal | None:
    """Match both views with their predicted content at a place and fit an upright pose."""
    # Minimum number of matches, over both views, that must agree on one pose to recognise a
    # place.
    min_agreeing = 8
    cam_from_place = place.inverse()
    sides = walls.sides_around(cam_from_place)
    matches = [
        match_pooled(
            side.features.descriptors,
            m.descriptors,
            m.points_world,
            m.radii,
            walls.search.config.walls.matching,
        )
        for side, m in sides
    ]
    agreeing = _find_agreement(sides, matches, cam_from_place)
    if agreeing is None or agreeing[0] < min_agreeing:
        return None
    if (found := merge_matches(sides, matches, walls.camera)) is None:
        return None
    return VirtualViewProposal(
        walls.search,
        "walls",
        found,
        num_agreeing=agreeing[0],
        cam_from_world=agreeing[1] @ cam_from_place,
        walls=walls,
    )


def _find_agreement(
    sides: Sides, matches: list[Matches], cam_from_place: Rigid3
) -> tuple[int, Rigid3] | None:
    """Return the number of matches of both views that agree on one upright pose, and that pose
    (cam_from_place)."""
    if not sides:
        return None
    seen = [side.tangents[one.query_idx] for (side, _), one in zip(sides, matches, strict=True)]
    points = [m.points_world[one.train_idx] for (_, m), one in zip(sides, matches, strict=True)]
    return estimate_upright_pose(np.concatenate(seen), cam_from_place.apply(np.concatenate(points)))


def _fit(
    walls: VirtualViewSearch, found: PointMatches, near: Rigid3, max_error_px: float
) -> PoseFit | None:
    """Refine the pose, or estimate it without a start if that gives more inliers nearby.

    A plane admits a second pose.
    """
    sigma_px, parts = walls.search.weights.walls.sigma_px, (found.local_map, found.matches)
    config = AbsolutePoseConfig(
        max_reprojection_error_px=max_error_px, sigma_px=sigma_px, max_iterations=400
    )
    refined, anew = (
        fit_pose(found.features, walls.camera, *parts, config, start)
        for start in ((near, walls.camera), None)
    )
    if isinstance(anew, PoseFit) and _are_near(walls.search, anew.cam_from_world, near):
        refined = max(refined, anew, key=lambda fit: fit.num_inliers)
    return refined if isinstance(refined, PoseFit) else None


def _score(proposal: VirtualViewProposal, final: PoseFit) -> Hypothesis:
    walls, search, num = proposal.walls, proposal.search, final.num_inliers
    guided = walls.guided(search.config.walls.rounds[-1][0])
    sides = walls.sides_around(final.cam_from_world)
    counts = count_virtual_views(sides, final.cam_from_world, guided)
    inflated = (
        covariance_inflation(num, search.correlated_error_share)
        + search.weights.walls.few_points / num
    )
    covariance = final.pose.inflated(inflated)
    columns_img = final.features.points_img[final.inlier_query_idx, 0]
    num_left = int(np.count_nonzero(columns_img < final.camera.cx))
    evidence = replace(
        measure_evidence(
            final,
            covariance,
            counts.num_visible,
            counts.agreeing_img,
            counts.visible_img,
            search.config.evidence,
        ),
        num_matches=len(proposal.fit.matches),
        num_inliers=proposal.num_agreeing,
        num_by_chance=counts.num_by_chance,
        num_distinct=_num_distinct(walls, final),
        num_lesser_side=min(num_left, num - num_left),
    )
    log_odds = search.weights.log_odds(evidence)
    noise_share = final.pose.noise_share(inflated)
    return Hypothesis("walls", final, evidence, covariance, noise_share, log_odds)


def _num_distinct(walls: VirtualViewSearch, final: PoseFit) -> int:
    """Count the inliers that match better here than with any distant point of the other places."""
    rows, columns = final.inlier_query_idx, final.inlier_point_idx
    descriptors, points_world = (
        final.features.descriptors[rows],
        final.local_map.points_world[columns],
    )
    products = np.sum(descriptors * final.local_map.descriptors[columns], axis=1)
    distances = np.sqrt(np.maximum(2.0 - 2.0 * products, 0.0))
    away = 1.5 * walls.search.config.walls.min_distance * walls.search.map.d_thresh
    is_far = (
        np.linalg.norm(walls.local_map_of_places.points_world - points_world.mean(axis=0), axis=1)
        > away
    )
    distant_matches = match_features(
        descriptors, walls.local_map_of_places.descriptors[is_far], MatchingConfig.nearest()
    )
    rivals = np.full(len(rows), np.inf)
    rivals[distant_matches.query_idx] = distant_matches.distances
    return int(np.count_nonzero(distances < rivals))


def _is_seen_by_nodes(search: Search, cam_from_world: Rigid3) -> bool:
    """Return whether nodes of the map have nearly this pose."""
    distances = search.map.distances(cam_from_world.inverse())
    return bool(distances.min() < search.config.walls.min_distance * search.map.d_thresh)


def _are_near(search: Search, a_from_world: Rigid3, b_from_world: Rigid3) -> bool:
    """Return whether two imprecise proposals are so close that only one is refined."""
    return a_from_world.inverse().is_same(
        b_from_world.inverse(), 1.5 * search.map.d_thresh, math.radians(20.0)
    )
