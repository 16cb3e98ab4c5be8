"""Propose poses from virtual views, for a return along a trajectory mapped in one direction.

This is the last source of proposals. The image's views to the left and right
(`features/extraction.py`) are compared with the virtual views of the map. Candidate places come
from `virtual_view_index.py`. A pose that matches of both views agree on is refined in both together
(`virtual_view_matching.py`). Few strong features are matched first. All are matched if enough of
these agree on one upright pose.

PnP on matches with one wall is ambiguous. The points are coplanar, and a plane admits a second pose
that looks nearly the same from the other slant. But people and robots carry cameras upright. Two
such cameras differ by a rotation about the vertical and a translation, which two matches determine
(Kukelova, Bujnak and Pajdla, 2010: pose of a camera with known vertical direction). The pose with
the most agreeing matches is proposed. Its tilt is estimated later.

Walls repeat, doors above all. So the evidence also counts the key points that match here better
than anywhere else in the virtual views. Poses near nodes with the same viewing direction are
skipped, because those nodes would have found them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from topoloc.features.features import Matches, MatchingConfig
from topoloc.features.matching import Matcher, match_features
from topoloc.geometry.absolute_pose import AbsolutePoseConfig
from topoloc.geometry.camera import UncalibratedCamera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.belief import Hypothesis
from topoloc.localization.evidence import measure_evidence
from topoloc.localization.pose_fit import PointMatches, PoseFit, fit_pose
from topoloc.localization.search import Proposal, Search
from topoloc.localization.walls.upright_pose_kernels import largest_pose_agreement, poses_from_pairs
from topoloc.localization.walls.virtual_view_index import VirtualViewIndex
from topoloc.localization.walls.virtual_view_matching import (
    Sides,
    VirtualViewSearch,
    count_virtual_views,
    merge_matches,
)

_NUM_PAIRS = 1500
_MAX_YAW = math.radians(35.0)
# minimum tangent between the two key points of a pair; closer ones do not constrain the distance
_MIN_SEPARATION = 0.1
_MIN_DEPTH, _MAX_DEPTH = 0.2, 100.0  # metres: allowed depth of the points of a pair
_TOLERANCE, _TOLERANCE_SHARE = (
    0.02,
    0.015,
)  # tangents: allowance for a tilted camera, larger off the axis


@dataclass(frozen=True, eq=False, kw_only=True)
class VirtualViewProposal(Proposal):
    """Hold a pose proposal on which `num_agreeing` matches of both views with one place agree."""

    num_agreeing: int
    cam_from_world: Rigid3
    walls: VirtualViewSearch

    def refine(self) -> PoseFit | None:
        """Return the pose refined with matches of both views.

        None if too few points agree, the pose is near the map's nodes, or was found already.
        """
        walls, search, fit = self.walls, self.search, None
        cam_from_world, min_inliers = self.cam_from_world, search.config.evidence.min_inliers
        with search.query.clock.stage("walls"):
            for radius_px, max_error_px in search.config.walls.rounds:
                if _is_seen_by_nodes(search, cam_from_world):
                    return None
                found = walls.match(cam_from_world, radius_px) if radius_px > 0.0 else self.fit
                fit = None if found is None else _fit(walls, found, cam_from_world, max_error_px)
                if fit is None or fit.num_inliers < min_inliers or _is_found(search, fit):
                    return None
                cam_from_world = fit.pose.cam_from_world
            return None if _is_seen_by_nodes(search, cam_from_world) else fit

    def score(self, final: PointMatches) -> Hypothesis | None:
        """Return the refined pose as a hypothesis. None if too few points were found."""
        min_found = 20  # minimum number of map points found at their predicted pixels
        if not isinstance(final, PoseFit) or final.num_inliers < min_found:
            return None
        with self.search.query.clock.stage("walls"):
            walls, search, num = self.walls, self.search, final.num_inliers
            guided = walls.guided(search.config.walls.rounds[-1][0])
            sides = walls.sides_around(final.pose.cam_from_world)
            counts = count_virtual_views(sides, final.pose.cam_from_world, guided)
            inflated = (
                1.0 + num * search.correlated_error_share + search.weights.walls.few_points / num
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
                num_matches=len(self.fit.matches),
                num_inliers=self.num_agreeing,
                num_by_chance=counts.num_by_chance,
                num_distinct=_num_distinct(walls, final),
                num_lesser_side=min(num_left, num - num_left),
            )
            log_odds = search.weights.log_odds(evidence)
            noise_share = final.pose.noise_share(inflated)
            return Hypothesis("walls", final, evidence, covariance, noise_share, log_odds)


@dataclass(frozen=True, eq=False)
class Comparison:
    """Hold both views beside their predicted content at a place.

    Of the matches of the strongest features, `num_strong` agree on one upright pose. `matchers`
    match further features of each view.
    """

    walls: VirtualViewSearch
    cam_from_place: Rigid3
    sides: Sides
    matchers: list[Matcher]
    num_strong: int

    @staticmethod
    def at_place(walls: VirtualViewSearch, place: Rigid3) -> Comparison:
        """Match the strongest features of both views with the points predicted from a place."""
        cam_from_place, weights = place.inverse(), walls.search.weights.walls
        sides, config = walls.sides_around(cam_from_place), walls.search.config.walls.matching
        matchers = [
            Matcher(side.features.descriptors, m.descriptors, (m.points_world, m.radii), config)
            for side, m in sides
        ]
        matches = [matcher.match_first(weights.stop.num_strong) for matcher in matchers]
        agreeing = _find_agreement(sides, matches, cam_from_place)
        num_strong = 0 if agreeing is None else agreeing[0]
        return Comparison(walls, cam_from_place, sides, matchers, num_strong)

    def match_all(self) -> VirtualViewProposal | None:
        """Match all features and propose the upright pose that most matches agree on. None if too
        few do to recognise a place."""
        stop = self.walls.search.weights.walls.stop
        matches = [matcher.match_first() for matcher in self.matchers]
        agreeing = _find_agreement(self.sides, matches, self.cam_from_place)
        if agreeing is None or agreeing[0] < stop.min_agreeing:
            return None
        merged = merge_matches(self.sides, matches, self.walls.camera)
        if merged is None:
            return None
        return VirtualViewProposal(
            self.walls.search,
            "walls",
            merged,
            num_agreeing=agreeing[0],
            cam_from_world=agreeing[1] @ self.cam_from_place,
            walls=self.walls,
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


def estimate_upright_pose(
    seen: Float[np.ndarray, "n 2"], points: Float[np.ndarray, "n 3"]
) -> tuple[int, Rigid3] | None:
    """Return the number of matches that agree on one upright pose, and that cam_from_upright.

    None if fewer than three matches agree.

    Args:
        seen: position of each matched point in the camera, as tangents (x / z, y / z).
        points: the same points (metres) in the frame of another upright camera. Poses rotated by
            more than 35 degrees from it are not considered.
    """
    if len(seen) < 3:
        return None
    pairs = np.random.default_rng(0).integers(0, len(seen), (2, _NUM_PAIRS))
    limits = _MIN_SEPARATION, _MAX_YAW, _MIN_DEPTH, _MAX_DEPTH
    turns, shifts = poses_from_pairs(seen, points, pairs, limits)
    if len(turns) == 0:
        return None
    tolerances = _TOLERANCE + _TOLERANCE_SHARE * np.sum(seen**2, axis=1)
    best, num_agreeing = largest_pose_agreement(seen, points, turns, shifts, tolerances, _MIN_DEPTH)
    if num_agreeing < 3:
        return None
    return num_agreeing, _upright_pose(float(turns[best]), shifts[best])


def _upright_pose(turn: float, shift: Float[np.ndarray, " 3"]) -> Rigid3:
    c, s = math.cos(turn), math.sin(turn)
    return Rigid3(np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]), shift)


def propose_virtual_views(search: Search) -> Iterator[Proposal]:
    """Generate the proposals with the most agreeing matches."""
    clear_log_odds = 2.5  # virtual views are skipped if a pose of the nodes has higher log-odds
    max_hypotheses = 4  # maximum number of pose proposals that are refined
    config, best = search.config.walls, search.best
    is_explained_by_nodes = (
        best is not None
        and best.probability >= search.config.evidence.min_probability
        and best.log_odds > clear_log_odds
    )
    if (
        is_explained_by_nodes
        or config.num_places == 0
        or isinstance(search.query.input_camera, UncalibratedCamera)
        or (index := search.map.walls) is None
    ):
        return
    with search.query.clock.stage("walls"):
        if not _may_show_place(search, index):
            return
        walls = VirtualViewSearch.around(search, index)
        compared = [Comparison.at_place(walls, place) for place in walls.places]
        compared.sort(key=lambda one: -one.num_strong)
    tried = list[VirtualViewProposal]()
    for one in compared:
        if (
            len(tried) == max_hypotheses
            or (len(tried) >= 2 and _is_hopeless(search))
            or one.num_strong < _min_strong(search, compared[0])
        ):
            return
        with search.query.clock.stage("walls"):
            proposal = _look_closer(one, tried)
        if proposal is not None:
            tried.append(proposal)
            yield proposal


def _may_show_place(search: Search, index: VirtualViewIndex) -> bool:
    """Return whether the nearest parts of the walls alone agree with a candidate place. They take
    half as long to extract, and a right place shows itself in them.

    They nearly always agree where the retrieved nodes do, and are not asked there."""
    stop = search.weights.walls.stop
    if stop.near_tangent <= 0.0 or search.num_retrieved >= search.config.num_chance_inliers:
        return True
    near = VirtualViewSearch.around(search, index, stop.near_tangent)
    return any(
        Comparison.at_place(near, place).num_strong >= stop.min_strong for place in near.places
    )


def _is_hopeless(search: Search) -> bool:
    """Return whether no pose from virtual views is nearly probable. After two such poses of the
    best places no further one was right (corridors of seeds 1 to 3 and 5, in reverse)."""
    found = (one for one in search.belief.hypotheses if not one.evidence.is_of_nodes)
    return max((one.log_odds for one in found), default=-math.inf) < -2.0


def _min_strong(search: Search, best: Comparison) -> int:
    """Return the minimum agreement of strong matches at a further place. If virtual views led to a
    clear pose, far fewer matches than at the best place cannot rival it."""
    min_share = 0.5
    least, found = search.weights.walls.stop.min_strong, search.best
    is_clear = found is not None and search.is_clear and not found.evidence.is_of_nodes
    return max(least, round(min_share * best.num_strong)) if is_clear else least


def _look_closer(
    compared: Comparison, tried: list[VirtualViewProposal]
) -> VirtualViewProposal | None:
    """Match all features at a place, and again from the pose that it led to. None if too few
    matches agree, or a pose nearby was tried."""

    def is_new(one: VirtualViewProposal) -> bool:
        search = one.walls.search
        return not any(_are_near(search, one.cam_from_world, k.cam_from_world) for k in tried)

    found = compared.match_all()
    if found is None or not is_new(found):
        return None
    found = _compare_again(found)
    return found if is_new(found) else None


def _compare_again(proposal: VirtualViewProposal) -> VirtualViewProposal:
    """Match again from the proposal's own pose, and keep the result if more matches agree.

    The candidate place was only near the pose.
    """
    again = Comparison.at_place(proposal.walls, proposal.cam_from_world.inverse()).match_all()
    return again if again is not None and again.num_agreeing > proposal.num_agreeing else proposal


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
    if isinstance(anew, PoseFit) and _are_near(walls.search, anew.pose.cam_from_world, near):
        refined = max(refined, anew, key=lambda fit: fit.num_inliers)
    return refined if isinstance(refined, PoseFit) else None


def _num_distinct(walls: VirtualViewSearch, final: PoseFit) -> int:
    """Count the inliers that match better here than with any distant point of the other places."""
    rows, columns = final.inlier_query_idx, final.inlier_point_idx
    descriptors, points_world = (
        final.features.descriptors[rows],
        final.local_map.points_world[columns],
    )
    products = np.sum(descriptors * final.local_map.descriptors[columns], axis=1)
    distances = np.sqrt(np.maximum(2.0 - 2.0 * products, 0.0))
    is_far = (
        np.linalg.norm(walls.local_map_of_places.points_world - points_world.mean(axis=0), axis=1)
        > 1.5 * walls.search.config.walls.min_distance * walls.search.map.d_thresh
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


def _is_found(search: Search, fit: PoseFit) -> bool:
    """Return whether a probable hypothesis of virtual views has this pose. Neighbouring places lead
    to one pose, and the one with the most agreeing matches comes first."""
    config = search.config.evidence
    tolerances = config.max_translation, math.radians(config.max_rotation_deg)
    return any(
        not one.evidence.is_of_nodes
        and one.probability >= config.min_probability
        and one.world_from_cam.is_same(fit.world_from_cam, *tolerances)
        for one in search.belief.hypotheses
    )


def _are_near(search: Search, a_from_world: Rigid3, b_from_world: Rigid3) -> bool:
    """Return whether two imprecise proposals are so close that only one is refined."""
    return a_from_world.inverse().is_same(
        b_from_world.inverse(), 1.5 * search.map.d_thresh, math.radians(20.0)
    )
