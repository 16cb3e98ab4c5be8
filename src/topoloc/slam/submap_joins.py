"""Join sub-maps without a common loop by the consensus of many weak image pairs.

Across a gap two sub-maps share little: a few images at their ends, from other viewpoints. Each pair
has too few matches to be accepted alone. So weakly matching pairs are collected in both directions,
together with those of neighbouring key frames. Each pair estimates the transform between the
sub-maps. The two are joined if enough independent pairs agree (`geometry/transform_consensus.py`).

Two floors of one building may also agree on what they have in common. So the nearest key frames
after the join are compared. Points that both must see from similar viewpoints have to match. In a
different place hardly any do. Images of repetitive structures are not used.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from itertools import product

import numpy as np
from jaxtyping import Float, Int

from topoloc.geometry.rigid import Rigid3, inverse_covariance, positions_of
from topoloc.geometry.transform_consensus import (
    TransformConsensus,
    diagonal_covariance,
    find_consensus,
    propagate_estimate,
)
from topoloc.slam.keyframes import KeyFrame, PlaceFeatures
from topoloc.slam.loop_closure import Link, is_distinct, is_reachable, match_keyframes, rank_places

_MIN_INLIERS = 12  # matches of a pair that agree on a pose
_MIN_ROTATION_TRACE = 1.0  # of a rotation by 90 degrees, beyond which images hardly overlap
_CANDIDATE_FACTOR = 10  # candidate pairs per checked pair

_Ends = tuple[KeyFrame, KeyFrame]
"""The best matching key frames of the earlier and the later sub-map. Estimates of the transform
between the sub-maps refer to these two."""
PlaceExtractor = Callable[[KeyFrame], PlaceFeatures]
"""A function that extracts the place features of a key frame from its recording."""


def find_joins(
    keyframes: Sequence[KeyFrame], links: Sequence[Link], extract_place: PlaceExtractor
) -> list[Link]:
    """Return links that join sub-maps which `links` leaves apart. Compared key frames get place
    features."""
    num_seeds = 6  # number of best matching pairs whose neighbours are compared, too
    groups = group_submaps(keyframes, links)
    places = [i for i, keyframe in enumerate(keyframes) if keyframe.has_place]
    if len(set(groups.values())) < 2 or len(places) < 2:
        return []
    joins: list[Link] = []
    repeated: dict[int, int] = {}
    for pairs in _find_similar_places(keyframes, places, groups).values():
        found = _match_pairs(pairs, keyframes)
        seeds = sorted(found, key=lambda link: -len(link.match.source_rows))[:num_seeds]
        around = _find_neighbour_pairs(seeds, keyframes) - set(pairs)
        for i in sorted({i for pair in around for i in pair}):
            if not keyframes[i].has_place:
                keyframes[i].place = extract_place(keyframes[i])
        found += _match_pairs(sorted(around), keyframes)
        distinct = [k for k in found if is_distinct(k, keyframes, repeated, _MIN_INLIERS)]
        joins += _select_consistent(distinct, keyframes)
    return joins


def _select_consistent(links: Sequence[Link], keyframes: Sequence[KeyFrame]) -> list[Link]:
    """Return the agreeing links between two sub-maps, none if too few agree or other images
    contradict them."""
    if not links:
        return []
    best = max(links, key=lambda link: len(link.match.source_rows))
    first, second = (keyframes[i] for i in _order_ends(best, keyframes))
    ends = first, second
    estimates, covariances = _compute_estimates(links, keyframes, ends)
    pictures = np.array([_order_ends(link, keyframes) for link in links])
    consensus = find_consensus(estimates, covariances, pictures)
    if consensus is None or not _is_join_verified(consensus, keyframes, ends):
        return []
    return [link for link, is_inlier in zip(links, consensus.is_inlier, strict=True) if is_inlier]


def group_submaps(keyframes: Sequence[KeyFrame], links: Sequence[Link]) -> dict[int, int]:
    """Return the first sub-map of the linked group of each sub-map."""
    groups = {keyframe.submap: keyframe.submap for keyframe in keyframes}
    for link in links:
        one, other = (groups[keyframes[end].submap] for end in (link.source, link.target))
        groups = {
            submap: min(one, other) if group in (one, other) else group
            for submap, group in groups.items()
        }
    return groups


def _find_similar_places(
    keyframes: Sequence[KeyFrame], places: list[int], groups: dict[int, int]
) -> dict[tuple[int, int], list[tuple[int, int]]]:
    """Return the similar pairs (earlier, later) of each two sub-maps that are apart."""
    # Number of most similar places in each other sub-map that a place is compared with.
    num_candidates = 4
    pairs: dict[tuple[int, int], set[tuple[int, int]]] = defaultdict(set)
    for place, ranked in zip(places, rank_places([keyframes[i] for i in places]), strict=False):
        num_of: Counter[int] = Counter()
        for other in (places[row] for row in ranked):
            own, submap = keyframes[place].submap, keyframes[other].submap
            num_of[submap] += 1
            if groups[submap] != groups[own] and num_of[submap] <= num_candidates:
                ends = (place, other) if own < submap else (other, place)
                pairs[min(own, submap), max(own, submap)].add(ends)
    return {submaps: sorted(pairs[submaps]) for submaps in sorted(pairs)}


def _find_neighbour_pairs(
    links: Sequence[Link], keyframes: Sequence[KeyFrame]
) -> set[tuple[int, int]]:
    """Return the pairs (earlier, later) of key frames around those of the links."""
    # Number of key frames before and after each end of these pairs that are compared.
    num_around = 2
    rows_of: dict[int, list[int]] = defaultdict(list)  # the key frames of each sub-map
    for i, keyframe in enumerate(keyframes):
        rows_of[keyframe.submap].append(i)
    pairs: set[tuple[int, int]] = set()
    for link in links:
        around = []
        for end in _order_ends(link, keyframes):
            rows = rows_of[keyframes[end].submap]
            at = rows.index(end)
            around.append(rows[max(at - num_around, 0) : at + num_around + 1])
        pairs |= set(product(*around))
    return pairs


def _match_pairs(pairs: Sequence[tuple[int, int]], keyframes: Sequence[KeyFrame]) -> list[Link]:
    """Match each pair in both directions.

    Links within a recording that exceed the camera's maximum speed are skipped.
    """
    links = (
        match_keyframes(source, target, keyframes, _MIN_INLIERS, min_inlier_share=0.3)
        for pair in pairs
        for source, target in (pair, pair[::-1])
    )
    return [
        link
        for link in links
        if link is not None
        and (
            keyframes[link.source].recording != keyframes[link.target].recording
            or is_reachable(link, keyframes)
        )
    ]


def _order_ends(link: Link, keyframes: Sequence[KeyFrame]) -> list[int]:
    """Return the link's end in the earlier sub-map, and that in the later one."""
    return sorted((link.source, link.target), key=lambda i: keyframes[i].submap)


def _compute_estimates(
    links: Sequence[Link], keyframes: Sequence[KeyFrame], ends: _Ends
) -> tuple[list[Rigid3], Float[np.ndarray, "n 6 6"]]:
    """Return first_from_second of each link, and the covariances.

    The covariance grows with the distance along the sub-maps.
    """
    # Factor of the PnP covariance, because matched features of one view have correlated errors.
    covariance_scale = 4.0
    of_match = diagonal_covariance(0.03, 1.0)  # in addition to that of PnP
    estimates, covariances = [], []
    for link in links:
        a, b = _order_ends(link, keyframes)
        first_from_a = ends[0].cam_from_world @ keyframes[a].cam_from_world.inverse()
        b_from_second = keyframes[b].cam_from_world @ ends[1].cam_from_world.inverse()
        a_from_b = link.match.target_from_source
        covariance = covariance_scale * link.match.covariance + of_match
        if link.source == a:
            a_from_b, covariance = a_from_b.inverse(), inverse_covariance(a_from_b, covariance)
        found = propagate_estimate(first_from_a, a_from_b, covariance, b_from_second)
        estimates.append(found[0])
        covariances.append(found[1])
    return estimates, np.stack(covariances)


def _is_join_verified(
    consensus: TransformConsensus, keyframes: Sequence[KeyFrame], ends: _Ends
) -> bool:
    """Return whether enough of the points that must look the same are matched.

    The matches must also be spread over the images.
    """
    # Minimum share of these points that are matched consistently with the join, and that are in
    # image cells with a match, because the same board may hang in two rooms.
    min_seen_again, min_covered = 0.08, 0.55
    min_seen_points = 100
    min_known_pose = 6  # matches that agree on a known pose
    num_cells = 4  # across and down an image
    counts = np.zeros(3, np.int64)  # points that must look the same, matched ones, those in cells
    for source, target, rows in _find_overlapping_views(consensus.a_from_b, keyframes, ends):
        camera, features = keyframes[source].stereo.camera, keyframes[source].place.features
        columns_rows = num_cells * features.points_img / [camera.width, camera.height]
        columns_rows = np.clip(np.floor(columns_rows).astype(np.int64), 0, num_cells - 1)
        cells = columns_rows @ [1, num_cells]  # of each feature
        seen = np.bincount(cells[rows], minlength=num_cells**2)
        found = np.zeros_like(seen)
        link = match_keyframes(source, target, keyframes, min_known_pose, min_inlier_share=0.0)
        if link is not None:
            (estimate,), (covariance,) = _compute_estimates([link], keyframes, ends)
            if consensus.is_consistent(estimate, covariance):
                again = np.intersect1d(link.match.source_rows, rows)
                found = np.bincount(cells[again], minlength=len(seen))
        counts += [seen.sum(), found.sum(), seen[found > 0].sum()]
    num_seen, num_found, num_covered = counts.tolist()
    enough = num_found >= min_seen_again * num_seen and num_covered >= min_covered * num_seen
    return num_seen >= min_seen_points and enough


def _find_overlapping_views(
    first_from_second: Rigid3, keyframes: Sequence[KeyFrame], ends: _Ends
) -> list[tuple[int, int, Int[np.ndarray, " n"]]]:
    """Return source, target and covisible features of the most overlapping pairs, in both
    directions."""
    num_checked = 20  # number of most similar views that are compared to verify a join
    ones, others = (
        [i for i, k in enumerate(keyframes) if k.submap == end.submap and k.has_place]
        for end in (ends[0], ends[1])
    )
    first_from_ones = [ends[0].cam_from_world @ keyframes[a].cam_from_world.inverse() for a in ones]
    first_from_others = [
        first_from_second @ ends[1].cam_from_world @ keyframes[b].cam_from_world.inverse()
        for b in others
    ]
    rotations, other_rotations = (
        np.array([pose.rotation for pose in poses])
        for poses in (first_from_ones, first_from_others)
    )
    turned = np.einsum("aij,bij->ab", rotations, other_rotations)
    places, other_places = map(positions_of, (first_from_ones, first_from_others))
    apart = np.linalg.norm(places[:, None] - other_places, axis=2)
    nearest = np.argsort(
        np.where(turned > _MIN_ROTATION_TRACE, apart, np.inf), axis=None, kind="stable"
    )[: _CANDIDATE_FACTOR * num_checked]
    views = []
    for a, b in np.column_stack(np.unravel_index(nearest, apart.shape)).tolist():
        b_from_a = first_from_others[b].inverse() @ first_from_ones[a]
        one, other = keyframes[ones[a]], keyframes[others[b]]
        views += [(ones[a], others[b], _find_covisible_features(one, other, b_from_a))]
        views += [(others[b], ones[a], _find_covisible_features(other, one, b_from_a.inverse()))]
    return sorted(views, key=lambda view: -len(view[2]))[:num_checked]


def _find_covisible_features(
    source: KeyFrame, target: KeyFrame, target_from_source: Rigid3
) -> Int[np.ndarray, " n"]:
    """Return the features of `source` in view of `target` from a similar direction and distance."""
    # Maximum angle (degrees) between two directions, and maximum ratio of two distances, from which
    # a point looks the same.
    max_angle_deg, max_ratio = 15.0, 1.3
    place = source.place
    valid = np.flatnonzero(place.points.valid)
    points = target_from_source.apply(place.points.points_cam[valid])
    pixels, camera = target.stereo.project(points)[:, :2], target.stereo.camera
    with np.errstate(invalid="ignore"):
        is_inside = np.all(
            (pixels > 0.0) & (pixels < [camera.width - 1.0, camera.height - 1.0]), axis=1
        )
    rays = points - target_from_source.translation
    lengths, others = np.linalg.norm(points, axis=1), np.linalg.norm(rays, axis=1)
    is_from_side = (
        np.sum(points * rays, axis=1) > np.cos(np.deg2rad(max_angle_deg)) * lengths * others
    )
    is_as_far = (lengths < max_ratio * others) & (others < max_ratio * lengths)
    return valid[is_inside & is_from_side & is_as_far]
