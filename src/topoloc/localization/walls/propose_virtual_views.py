"""Propose poses from virtual views, for a return along a trajectory mapped in one direction.

This is the last source of proposals. The image's views to the left and right
(`features/virtual_views.py`) are compared with the virtual views of the map. Candidate places come
from `candidate_places.py`. A pose that matches of both views agree on (`upright_pose.py`) is
refined in both together (`virtual_view_matching.py`).

Walls repeat, doors above all. So the evidence also counts the key points that match here better
than anywhere else in the virtual views. Poses near nodes with the same viewing direction are
skipped, because those nodes would have found them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from jaxtyping import UInt8

from topoloc.features.config import MatchingConfig
from topoloc.features.extraction import extract_from_normalized, normalize_image
from topoloc.features.feature_types import FeatureConfig
from topoloc.features.features import Features
from topoloc.features.matching import match_features, match_pooled
from topoloc.features.virtual_views import VirtualView, make_virtual_views
from topoloc.geometry.absolute_pose import AbsolutePose, AbsolutePoseConfig
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.geometry.uncalibrated_camera import UncalibratedCamera
from topoloc.localization.belief import Hypothesis
from topoloc.localization.evidence import (
    compute_inlier_spread,
    compute_log_odds,
    compute_normalized_uncertainty,
    compute_uniform_inlier_ratio,
)
from topoloc.localization.guided import GuidedConfig
from topoloc.localization.map_facts.correlated_errors import covariance_inflation
from topoloc.localization.pose_fit import LocalMap, PointMatches, PoseFit
from topoloc.localization.provenance import Evidence
from topoloc.localization.search import Proposal, Search
from topoloc.localization.walls.candidate_places import CandidatePlaces, select_likeliest_places
from topoloc.localization.walls.upright_pose import estimate_upright_pose
from topoloc.localization.walls.virtual_view_index import VirtualViewIndex
from topoloc.localization.walls.virtual_view_matching import (
    QueryVirtualView,
    VirtualViewMatches,
    count_virtual_views,
    estimate_pose,
    match_virtual_views,
    merge_matches,
    select_nearest_virtual_nodes,
)
from topoloc.node_ids import Row

_NEAREST_NEIGHBOR = MatchingConfig(ratio=0.0, mutual=False)


@dataclass(frozen=True, eq=False, kw_only=True)
class VirtualViewProposal(Proposal):
    """Hold a pose proposal on which `num_agreeing` matches of both views with one place agree."""

    num_agreeing: int
    cam_from_world: Rigid3
    walls: VirtualViewSearch


@dataclass(frozen=True, eq=False)
class VirtualViewSearch:
    """Hold both side views of a query image and the candidate places (world_from_cam), likeliest
    first."""

    search: Search
    index: VirtualViewIndex
    seen: list[QueryVirtualView]
    places: list[Rigid3]

    @staticmethod
    def of(search: Search, index: VirtualViewIndex) -> VirtualViewSearch:
        """Extract both side views of the query image and select the candidate places."""
        num_d_thresh = 2.0  # minimum distance between these places, in D_thresh
        query, seen, named = search.query, list[QueryVirtualView](), list[CandidatePlaces]()
        assert isinstance(query.input_camera, Camera)
        for view in make_virtual_views(query.input_camera):
            picture = view.picture(query.grey)
            seen_by = (view.name, index.feature_config)
            features = query.shared.get_or_extract(
                query, seen_by, partial(_extract_view_features, index.feature_config, view, picture)
            )
            seen.append(
                QueryVirtualView(view, features, view.to_image_pixels(features, query.input_camera))
            )
            named.append(CandidatePlaces.of(view, index, index.similarity(picture, features)))
        apart = num_d_thresh * search.map.d_thresh
        return VirtualViewSearch(
            search,
            index,
            seen,
            select_likeliest_places(named, search.config.walls.num_places, apart),
        )

    @property
    def camera(self) -> Camera:
        """Return the camera of the query."""
        return self.search.query.camera

    def virtual_nodes_around(self, side: QueryVirtualView, cam_from_world: Rigid3) -> list[Row]:
        """Return the virtual views of the map that show the content of a side view at a pose."""
        # Number of virtual views around a pose whose points are searched in each side
        # view.
        num_nodes = 4
        return select_nearest_virtual_nodes(
            side.view,
            cam_from_world,
            self.index.centres,
            self.index.axes,
            num_nodes,
        )

    @cached_property
    def local_map_of_places(self) -> LocalMap:
        """Return the points visible from any of the candidate places."""
        rows = sorted(
            {
                row
                for place in self.places
                for side in self.seen
                for row in self.virtual_nodes_around(side, place.inverse())
            }
        )
        return LocalMap.concatenate([self.index.local_map(row) for row in rows])


def _extract_view_features(
    config: FeatureConfig, view: VirtualView, picture: UInt8[np.ndarray, "a b"]
) -> Features:
    """Extract the features of a view."""
    return view.select_inside(extract_from_normalized(normalize_image(picture, config), config))


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
    config, cam_from_place = walls.search.config.walls, place.inverse()
    sides = _views_around(walls, cam_from_place)
    matches = [
        match_pooled(
            side.features.descriptors, m.descriptors, m.points_world, m.radii, config.matching
        )
        for side, m in sides
    ]
    found = merge_matches(sides, matches)
    if found is None:
        return None
    seen = walls.camera.normalized_from_img(
        found.features.points_img[found.matches.query_idx].astype(np.float64)
    )
    agreeing = estimate_upright_pose(
        seen, cam_from_place.apply(found.local_map.points_world[found.matches.train_idx])
    )
    if agreeing is None or agreeing[0] < min_agreeing:
        return None
    fit = PointMatches(found.features, walls.camera, walls.camera, found.local_map, found.matches)
    return VirtualViewProposal(
        "walls",
        fit,
        is_guided=True,
        num_agreeing=agreeing[0],
        cam_from_world=agreeing[1] @ cam_from_place,
        walls=walls,
    )


def refine_virtual_view_pose(proposal: VirtualViewProposal) -> PoseFit | None:
    """Refine a proposal with matches of both views.

    None if too few points agree, or the pose is near the map's nodes.
    """
    walls, config = proposal.walls, proposal.walls.search.config
    cam_from_world, found, pose = proposal.cam_from_world, None, None
    for radius_px, max_error_px in config.walls.rounds:
        if _is_seen_by_nodes(walls.search, cam_from_world):
            return None
        found = _match_views(proposal, cam_from_world, radius_px)
        pose = _estimate(walls, found, cam_from_world, max_error_px) if found is not None else None
        if pose is None or np.count_nonzero(pose.inliers) < config.evidence.min_inliers:
            return None
        cam_from_world = pose.cam_from_world
    if found is None or pose is None or _is_seen_by_nodes(walls.search, cam_from_world):
        return None
    return PoseFit(found.features, walls.camera, walls.camera, found.local_map, found.matches, pose)


def score_virtual_view_pose(proposal: VirtualViewProposal, final: PoseFit) -> Hypothesis | None:
    """Score the refined pose and return it as a hypothesis. None if too few points were found."""
    min_found = 20  # minimum number of map points found at their predicted pixels
    walls, search, pose, camera = proposal.walls, proposal.walls.search, final.pose, final.camera
    if final.num_inliers < min_found:
        return None
    counts = count_virtual_views(
        _views_around(walls, pose.cam_from_world),
        pose.cam_from_world,
        _guided_config(walls, search.config.walls.rounds[-1][0]),
    )
    inflated = (
        covariance_inflation(final.num_inliers, search.correlated_error_share)
        + search.weights.walls.few_points / final.num_inliers
    )
    covariance = inflated * pose.covariance
    depths = pose.cam_from_world.apply(final.local_map.points_world[final.inlier_point_idx])[:, 2]
    points_img = final.features.points_img[final.inlier_query_idx].astype(np.float64)
    num_left = int(np.count_nonzero(points_img[:, 0] < camera.cx))
    agreeing_img = points_img if counts.agreeing_img is None else counts.agreeing_img
    evidence = Evidence(
        num_matches=len(proposal.fit.matches),
        num_inliers=proposal.num_agreeing,
        num_found=final.num_inliers,
        num_visible=counts.num_visible,
        num_by_chance=counts.num_by_chance,
        spread=compute_inlier_spread(points_img, camera.width, camera.height),
        doubt=compute_normalized_uncertainty(
            covariance, float(np.median(depths)), search.config.evidence
        ),
        even_share=compute_uniform_inlier_ratio(
            agreeing_img, counts.visible_img, camera.width, camera.height
        ),
        num_distinct=_num_distinct(walls, final),
        num_lesser_side=min(num_left, len(points_img) - num_left),
    )
    return Hypothesis(
        "walls",
        final,
        evidence,
        covariance,
        1.0 / inflated,
        compute_log_odds(evidence, search.weights),
    )


def _match_views(
    proposal: VirtualViewProposal, cam_from_world: Rigid3, radius_px: float
) -> VirtualViewMatches | None:
    """Return the proposal's own matches if the radius is 0, or guided matches around the pose."""
    if radius_px == 0.0:
        return VirtualViewMatches(
            proposal.fit.features, proposal.fit.local_map, proposal.fit.matches
        )
    return match_virtual_views(
        _views_around(proposal.walls, cam_from_world),
        cam_from_world,
        _guided_config(proposal.walls, radius_px),
    )


def _guided_config(walls: VirtualViewSearch, radius_px: float) -> GuidedConfig:
    return replace(walls.search.config.walls.guided, radius_px=radius_px)


def _views_around(
    walls: VirtualViewSearch, cam_from_world: Rigid3
) -> list[tuple[QueryVirtualView, LocalMap]]:
    """Return each side view with the points predicted in it."""
    return [
        (side, local_map)
        for side in walls.seen
        if (local_map := _local_map_around(walls, side, cam_from_world)) is not None
    ]


def _local_map_around(
    walls: VirtualViewSearch, side: QueryVirtualView, cam_from_world: Rigid3
) -> LocalMap | None:
    rows = walls.virtual_nodes_around(side, cam_from_world)
    return (
        LocalMap.concatenate([walls.index.local_map(row) for row in rows])
        if rows and len(side.features)
        else None
    )


def _estimate(
    walls: VirtualViewSearch, found: VirtualViewMatches, near: Rigid3, max_error_px: float
) -> AbsolutePose | None:
    """Refine the pose, or estimate it without a start if that gives more inliers nearby.

    A plane admits a second pose.
    """
    sigma_px = walls.search.weights.walls.sigma_px
    config = AbsolutePoseConfig(
        max_reprojection_error_px=max_error_px, sigma_px=sigma_px, max_iterations=400
    )
    refined, anew = (
        estimate_pose(found, walls.camera, config, near),
        estimate_pose(found, walls.camera, config, None),
    )
    if anew is None or not _are_near(walls.search, anew.cam_from_world, near):
        return refined
    return (
        anew
        if refined is None or np.count_nonzero(anew.inliers) > np.count_nonzero(refined.inliers)
        else refined
    )


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
        descriptors, walls.local_map_of_places.descriptors[is_far], _NEAREST_NEIGHBOR
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
