"""Sub-maps that no loop has joined, joined by what many of their pictures say together.

Across a gap two sub-maps share little: a few pictures at their ends, seen from elsewhere, with too
few matches for any of them to be believed alone. So pairs that match weakly are gathered, both
ways, with those of the key frames around them; each says where one sub-map lies in the other, and
what enough of them agree on, from pictures of which none counts twice, joins the two
(`transform_consensus`). Two floors of one building agree, too, on what they share. So key frames
that then are nearest to each other are looked at: what both must see alike has to be found again,
and of another place hardly any of it is. Pictures of a wall of equal panels say nothing here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int

from topoloc.bounds import Above, AtLeast, Between
from topoloc.geometry.rigid import Rigid3, inverse_covariance
from topoloc.geometry.transform_consensus import (
    ConsensusConfig,
    DriftConfig,
    TransformConsensus,
    diagonal_covariance,
    find_consensus,
    propagate_estimate,
)
from topoloc.slam.keyframes import KeyFrame, PlaceFeatures
from topoloc.slam.loop_closure import Link, LoopConfig, is_reachable, rank_places
from topoloc.slam.place_matching import PlaceMatchingConfig, count_repeated_features, match_places

_MIN_LOOSE_INLIERS = 6  # matches that agree on a pose which is known already
_MIN_ROTATION_TRACE = 1.0  # of a turn by 90 degrees: beyond it hardly anything is in both pictures
_CANDIDATE_FACTOR = (
    10  # times as many pairs as are checked, the nearest, are asked how much they must see alike
)

PlaceExtractor = Callable[[KeyFrame], PlaceFeatures]
"""What a key frame looks like, from its recording."""


@dataclass(frozen=True)
class JoinConfig:
    """Which pictures of two sub-maps are compared, and what joins them."""

    matching: PlaceMatchingConfig = field(
        default_factory=lambda: PlaceMatchingConfig(min_inliers=12, min_inlier_share=0.3)
    )
    consensus: ConsensusConfig = field(default_factory=lambda: ConsensusConfig(min_independent=3))
    num_candidates: Annotated[int, Between(0, 1000)] = 4
    """Places of the other sub-maps that look most alike, which each one is compared with."""
    num_seeds: Annotated[int, Between(0, 1000)] = 6
    """Of the pairs that match, around so many of the best ..."""
    neighbours: Annotated[int, Between(0, 100)] = 2
    """... so many key frames before and after either are compared, too."""
    sigma: Annotated[float, Above(0)] = 0.03
    """Metres by which a match may be wrong (one sigma), besides what PnP says ..."""
    sigma_deg: Annotated[float, Above(0)] = 1.0
    """... and degrees."""
    covariance_scale: Annotated[float, Above(0)] = 4.0
    """Matched features of one view share their errors: more than independent ones would be wrong
    by."""
    drift: Annotated[float, AtLeast(0)] = 0.02
    """Share of the way between two pictures of a sub-map by which they may be wrong (one sigma)
    ..."""
    drift_deg: Annotated[float, AtLeast(0)] = 0.3
    """... and degrees a metre."""
    num_checked: Annotated[int, Between(0, 1000)] = 20
    """Once joined, so many pairs of pictures that must be most alike are looked at."""
    alike_deg: Annotated[float, Between(0, 90)] = 15.0
    """A point is seen alike from directions that differ by less than this ..."""
    alike_ratio: Annotated[float, AtLeast(1)] = 1.3
    """... and from distances that differ by less than this factor."""
    min_seen_points: Annotated[int, AtLeast(1)] = 100
    """Points that must be seen alike at least, all those pairs together, ..."""
    min_seen_again: Annotated[float, Between(0, 1)] = 0.08
    """... the share of them that must be matched as the join has it, ..."""
    min_covered: Annotated[float, Between(0, 1)] = 0.55
    """... and the share of them that lie in parts of a picture where any is: a board may hang in
    two rooms."""
    cells: Annotated[int, Between(1, 100)] = 4
    """Such parts, across a picture and down."""


@dataclass(frozen=True, eq=False)
class _KeyFramePair:
    """The two key frames that match best, of the earlier and of the later sub-map: what is said of
    the two is said at these."""

    first: KeyFrame
    second: KeyFrame


def find_joins(
    keyframes: Sequence[KeyFrame],
    links: Sequence[Link],
    extract_place: PlaceExtractor,
    config: JoinConfig,
    loops: LoopConfig,
) -> list[Link]:
    """Links that join sub-maps which `links` leave apart; key frames that are compared get their
    place."""
    groups = group_submaps(keyframes, links)
    places = [i for i, keyframe in enumerate(keyframes) if keyframe.has_place]
    if len(set(groups.values())) < 2 or len(places) < 2:
        return []
    joins: list[Link] = []
    repeated: dict[int, int] = {}
    for pairs in _find_similar_places(keyframes, places, groups, config, loops).values():
        found = _match_pairs(pairs, keyframes, config, loops)
        seeds = sorted(found, key=lambda link: -len(link.match.source_rows))[: config.num_seeds]
        around = _find_neighbour_pairs(seeds, keyframes, config) - set(pairs)
        for i in sorted({i for pair in around for i in pair}):
            if not keyframes[i].has_place:
                keyframes[i].place = extract_place(keyframes[i])
        found += _match_pairs(sorted(around), keyframes, config, loops)
        joins += _select_consistent(
            [link for link in found if _is_distinct(link, keyframes, repeated, config)],
            keyframes,
            config,
        )
    return joins


def _is_distinct(
    link: Link, keyframes: Sequence[KeyFrame], repeated: dict[int, int], config: JoinConfig
) -> bool:
    """Whether neither picture looks nearly as much like itself, from elsewhere, as like the other;
    `repeated` remembers what did."""
    for end in (link.source, link.target):
        place = keyframes[end].place
        if end not in repeated and place is not None:
            repeated[end] = count_repeated_features(place, keyframes[end].stereo, config.matching)
    rivals = max(repeated[link.source], repeated[link.target])
    return rivals < max(
        config.consensus.rival_share * len(link.match.source_rows), config.matching.min_inliers
    )


def _select_consistent(
    links: Sequence[Link], keyframes: Sequence[KeyFrame], config: JoinConfig
) -> list[Link]:
    """Those of the links between two sub-maps that say the same, where enough do and what they say
    is true of other pictures."""
    if not links:
        return []
    best = max(links, key=lambda link: len(link.match.source_rows))
    ends = _KeyFramePair(*(keyframes[i] for i in _order_ends(best, keyframes)))
    estimates, covariances = _compute_estimates(links, keyframes, ends, config)
    pictures = np.array([_order_ends(link, keyframes) for link in links])
    consensus = find_consensus(estimates, covariances, config.consensus, pictures)
    if consensus is None or not _is_join_verified(consensus, keyframes, ends, config):
        return []
    return [link for link, is_inlier in zip(links, consensus.is_inlier, strict=True) if is_inlier]


def group_submaps(keyframes: Sequence[KeyFrame], links: Sequence[Link]) -> dict[int, int]:
    """Of each sub-map, the first one that links join it with."""
    groups = {keyframe.submap: keyframe.submap for keyframe in keyframes}
    for link in links:
        one, other = (groups[keyframes[end].submap] for end in (link.source, link.target))
        groups = {
            submap: min(one, other) if group in (one, other) else group
            for submap, group in groups.items()
        }
    return groups


def _find_similar_places(
    keyframes: Sequence[KeyFrame],
    places: list[int],
    groups: dict[int, int],
    config: JoinConfig,
    loops: LoopConfig,
) -> dict[tuple[int, int], list[tuple[int, int]]]:
    """For each two sub-maps that are apart, the pairs (of the earlier, of the later) that look
    alike."""
    pairs: dict[tuple[int, int], set[tuple[int, int]]] = {}
    for number, ranked in enumerate(rank_places([keyframes[i] for i in places], loops.vlad)):
        own = keyframes[places[number]].submap
        num_of: dict[int, int] = {}
        for other in ranked:
            submap = keyframes[places[other]].submap
            num_of[submap] = num_of.get(submap, 0) + 1
            if groups[submap] != groups[own] and num_of[submap] <= config.num_candidates:
                ends = (
                    (places[number], places[other])
                    if own < submap
                    else (places[other], places[number])
                )
                pairs.setdefault((min(own, submap), max(own, submap)), set()).add(ends)
    return {submaps: sorted(pairs[submaps]) for submaps in sorted(pairs)}


def _find_neighbour_pairs(
    links: Sequence[Link], keyframes: Sequence[KeyFrame], config: JoinConfig
) -> set[tuple[int, int]]:
    """Pairs of key frames around those of the links: of the earlier sub-map, of the later."""
    pairs: set[tuple[int, int]] = set()
    for link in links:
        one, other = (
            _find_neighbours(end, keyframes, config.neighbours)
            for end in _order_ends(link, keyframes)
        )
        pairs |= set(product(one, other))
    return pairs


def _find_neighbours(row: int, keyframes: Sequence[KeyFrame], num: int) -> list[int]:
    """Rows of the key frames of one sub-map around one of them, itself among them."""
    own = [i for i, keyframe in enumerate(keyframes) if keyframe.submap == keyframes[row].submap]
    at = own.index(row)
    return own[max(at - num, 0) : at + num + 1]


def _match_pairs(
    pairs: Sequence[tuple[int, int]],
    keyframes: Sequence[KeyFrame],
    config: JoinConfig,
    loops: LoopConfig,
) -> list[Link]:
    """Both ways of each pair, where it matches and the camera can have gone so."""
    links = []
    for source, target in (ends for pair in pairs for ends in (pair, pair[::-1])):
        a, b = keyframes[source].place, keyframes[target].place
        match = (
            match_places(a, b, keyframes[target].stereo, config.matching)
            if a is not None and b is not None
            else None
        )
        if match is not None:
            link = Link(source, target, match)
            if keyframes[source].recording != keyframes[target].recording or is_reachable(
                link, keyframes, loops
            ):
                links.append(link)
    return links


def _order_ends(link: Link, keyframes: Sequence[KeyFrame]) -> list[int]:
    """Its end in the earlier sub-map, and that in the later."""
    return sorted((link.source, link.target), key=lambda i: keyframes[i].submap)


def _compute_estimates(
    links: Sequence[Link], keyframes: Sequence[KeyFrame], ends: _KeyFramePair, config: JoinConfig
) -> tuple[list[Rigid3], Float[np.ndarray, "n 6 6"]]:
    """first_from_second as each link says, and the covariances; the further along the sub-maps it
    is, the less exactly."""
    estimates, covariances, along = [], [], DriftConfig(config.drift, config.drift_deg)
    for link in links:
        a, b = _order_ends(link, keyframes)
        first_from_a = ends.first.cam_from_world @ keyframes[a].cam_from_world.inverse()
        b_from_second = keyframes[b].cam_from_world @ ends.second.cam_from_world.inverse()
        a_from_b = link.match.target_from_source
        covariance = config.covariance_scale * link.match.covariance + diagonal_covariance(
            config.sigma, config.sigma_deg
        )
        if link.source == a:
            a_from_b, covariance = a_from_b.inverse(), inverse_covariance(a_from_b, covariance)
        estimate, carried_covariance = propagate_estimate(
            first_from_a, a_from_b, covariance, b_from_second, along
        )
        estimates.append(estimate)
        covariances.append(carried_covariance)
    return estimates, np.stack(covariances)


def _is_join_verified(
    consensus: TransformConsensus,
    keyframes: Sequence[KeyFrame],
    ends: _KeyFramePair,
    config: JoinConfig,
) -> bool:
    """Whether enough of what key frames of both sub-maps must see alike is matched, and not on one
    thing alone."""
    loosely = replace(config.matching, min_inliers=_MIN_LOOSE_INLIERS, min_inlier_share=0.0)
    num_seen, num_found, num_covered = 0, 0, 0
    for source, target, rows in _find_overlapping_views(
        consensus.a_from_b, keyframes, ends, config
    ):
        a, b = keyframes[source].place, keyframes[target].place
        assert a is not None
        assert b is not None
        cells = _compute_cells(a, keyframes[source], config)
        seen, found = (
            np.bincount(cells[rows], minlength=config.cells**2),
            np.zeros(config.cells**2, np.int64),
        )
        match = match_places(a, b, keyframes[target].stereo, loosely)
        if match is not None and _is_link_consistent(
            Link(source, target, match), consensus, keyframes, ends, config
        ):
            found = np.bincount(cells[np.intersect1d(match.source_rows, rows)], minlength=len(seen))
        num_seen, num_found, num_covered = (
            num_seen + seen.sum(),
            num_found + found.sum(),
            num_covered + seen[found > 0].sum(),
        )
    enough = (
        num_found >= config.min_seen_again * num_seen
        and num_covered >= config.min_covered * num_seen
    )
    return bool(num_seen >= config.min_seen_points and enough)


def _compute_cells(
    place: PlaceFeatures, keyframe: KeyFrame, config: JoinConfig
) -> Int[np.ndarray, " n"]:
    """In which cell of a grid over its picture each feature lies."""
    camera = keyframe.stereo.camera
    columns_rows = np.floor(
        config.cells * place.features.points_img / [camera.width, camera.height]
    ).astype(np.int64)
    return np.clip(columns_rows, 0, config.cells - 1) @ [1, config.cells]


def _is_link_consistent(
    link: Link,
    consensus: TransformConsensus,
    keyframes: Sequence[KeyFrame],
    ends: _KeyFramePair,
    config: JoinConfig,
) -> bool:
    estimates, covariances = _compute_estimates([link], keyframes, ends, config)
    residual = (estimates[0] @ consensus.a_from_b.inverse()).log()
    square = residual @ np.linalg.solve(covariances[0] + consensus.covariance, residual)
    return bool(square <= config.consensus.max_sigmas**2)


def _find_overlapping_views(
    first_from_second: Rigid3,
    keyframes: Sequence[KeyFrame],
    ends: _KeyFramePair,
    config: JoinConfig,
) -> list[tuple[int, int, Int[np.ndarray, " n"]]]:
    """Source, target and the source's features that are seen alike, of the pairs of places that
    have most of these; both ways."""
    ones, others = (
        [i for i, k in enumerate(keyframes) if k.submap == end.submap and k.has_place]
        for end in (ends.first, ends.second)
    )
    first_from_ones = [
        ends.first.cam_from_world @ keyframes[a].cam_from_world.inverse() for a in ones
    ]
    first_from_others = [
        first_from_second @ ends.second.cam_from_world @ keyframes[b].cam_from_world.inverse()
        for b in others
    ]
    places, other_places = (
        np.array([pose.translation for pose in poses])
        for poses in (first_from_ones, first_from_others)
    )
    turned = np.einsum(
        "aij,bij->ab",
        *(
            np.stack([pose.rotation for pose in poses])
            for poses in (first_from_ones, first_from_others)
        ),
    )
    apart = np.linalg.norm(places[:, None] - other_places, axis=2)
    nearest = np.argsort(
        np.where(turned > _MIN_ROTATION_TRACE, apart, np.inf), axis=None, kind="stable"
    )[: _CANDIDATE_FACTOR * config.num_checked]
    views = []
    for a, b in np.column_stack(np.unravel_index(nearest, apart.shape)).tolist():
        b_from_a = first_from_others[b].inverse() @ first_from_ones[a]
        one, other = keyframes[ones[a]], keyframes[others[b]]
        views += [(ones[a], others[b], _find_covisible_features(one, other, b_from_a, config))]
        views += [
            (others[b], ones[a], _find_covisible_features(other, one, b_from_a.inverse(), config))
        ]
    return sorted(views, key=lambda view: -len(view[2]))[: config.num_checked]


def _find_covisible_features(
    source: KeyFrame, target: KeyFrame, target_from_source: Rigid3, config: JoinConfig
) -> Int[np.ndarray, " n"]:
    """Which features of `source` lie within the picture of `target`, and are seen from about the
    same side and as far away."""
    place = source.place
    assert place is not None
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
        np.sum(points * rays, axis=1) > np.cos(np.deg2rad(config.alike_deg)) * lengths * others
    )
    is_as_far = (lengths < config.alike_ratio * others) & (others < config.alike_ratio * lengths)
    return valid[is_inside & is_from_side & is_as_far]
