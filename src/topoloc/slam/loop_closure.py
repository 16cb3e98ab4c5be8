"""Detect loops: key frames that see a place again, much later or in another recording.

Image retrieval proposes pairs. Local features and PnP verify them (`place_matching.py`). Four
checks prevent wrong links. Within a sub-map, a link must not imply more drift than the odometry can
have. Between two, its images must not be repetitive. No other link of nearly equal strength may
contradict it, which repetitive structures cause. A second link nearby must agree with it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise

import numpy as np
from jaxtyping import Float

from topoloc.compiled import parallel_map
from topoloc.disk_list import DiskList
from topoloc.geometry.rigid import Rigid3
from topoloc.retrieval.coarse import VladConfig
from topoloc.retrieval.vlad import SurfVlad, learn_words_from_parts, vlad
from topoloc.slam.keyframes import KeyFrame, compute_steps
from topoloc.slam.place_matching import PlaceMatch, find_repetition, match_places

_MAX_VLAD_BYTES = 4_000_000  # in memory: each is read once or twice, in order


@dataclass(frozen=True, eq=False)
class Link:
    """Link key frames `source` and `target` (rows in the list of all) that see the same place."""

    source: int
    target: int
    match: PlaceMatch


def find_links(
    keyframes: Sequence[KeyFrame],
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> list[Link]:
    """Return all links that pass the checks, in the order of their targets."""
    places = [i for i, keyframe in enumerate(keyframes) if keyframe.has_place]
    if len(places) < 2:
        return []
    proposals = _propose_pairs(keyframes, places)
    of_pair: dict[tuple[int, int], Link | None] = {}
    for pair, link in _match_pairs(proposals, keyframes):
        of_pair[pair] = link
        progress("loops", len(of_pair), len(proposals))
    links = [link for link in of_pair.values() if link is not None]
    rank = {keyframe: place for place, keyframe in enumerate(places)}

    def select_supported(links: list[Link]) -> list[Link]:
        return [
            k for k in links if any(_is_supporting(other, k, keyframes, rank) for other in links)
        ]

    repeated: dict[int, int] = {}
    plausible = [
        link
        for link in links
        if _is_within_drift(link, keyframes) and is_distinct(link, keyframes, repeated)
    ]
    supported = select_supported(
        [
            link
            for link in plausible
            if not any(_is_contradicting(other, link, keyframes) for other in plausible)
        ]
    )
    pairs = {link: _rival_pairs(link, keyframes, places) for link in supported}
    unknown = {pair for of_link in pairs.values() for pair in of_link} - of_pair.keys()
    of_pair |= dict(_match_pairs(sorted(unknown), keyframes))
    return select_supported(
        [
            link
            for link in supported
            if not any(_is_rival(of_pair[pair], link, keyframes) for pair in pairs[link])
        ]
    )


def _match_pairs(
    pairs: Sequence[tuple[int, int]], keyframes: Sequence[KeyFrame]
) -> Iterator[tuple[tuple[int, int], Link | None]]:
    """Generate each pair (target, source) with its link."""
    found = parallel_map(lambda pair: match_keyframes(pair[1], pair[0], keyframes), pairs)
    return zip(pairs, found, strict=True)


def _propose_pairs(keyframes: Sequence[KeyFrame], places: list[int]) -> list[tuple[int, int]]:
    """Return (target, source) of similar pairs. The source is the earlier one."""
    min_places_between = 12  # minimum number of places between two places of one sub-map

    def is_candidate(a: int, b: int) -> bool:
        same = keyframes[places[a]].submap == keyframes[places[b]].submap
        return a != b and (not same or abs(a - b) >= min_places_between)

    num_candidates = 4  # number of most similar places that each place is compared with
    num = num_candidates + 2 * min_places_between  # itself and its neighbours may come first
    pairs = {
        (places[max(number, other)], places[min(number, other)])
        for number, ranked in enumerate(rank_places([keyframes[i] for i in places], num))
        for other in [row for row in ranked if is_candidate(row, number)][:num_candidates]
    }
    return sorted(pairs)


def rank_places(keyframes: Sequence[KeyFrame], num: int | None = None) -> Iterator[list[int]]:
    """Generate, for each key frame, the rows of the `num` most similar ones (default: all), in
    order.

    Each key frame must have place features. Nothing is generated if there are no features at all.
    """
    config = VladConfig(num_words=32, position_weight=0.0)
    num_features = [len(keyframe.place.features) for keyframe in keyframes]
    if sum(num_features) == 0:
        return
    words = learn_words_from_parts(
        num_features, lambda row: keyframes[row].place.features.descriptors, config
    )
    vlads = DiskList(
        (vlad(k.place.features.descriptors, words) for k in keyframes), _MAX_VLAD_BYTES
    )
    localizer = SurfVlad.fit(words, vlads, np.arange(len(keyframes)), config)
    blank = np.zeros((1, 1), np.uint8)
    for keyframe in keyframes:
        scores = localizer.rank(blank, keyframe.place.features, num or len(keyframes))
        yield [score.row for score in scores]


def _is_within_drift(link: Link, keyframes: Sequence[KeyFrame]) -> bool:
    max_drift_deg = 15.0  # maximum rotation drift of the odometry, degrees, for any distance
    source, target = keyframes[link.source], keyframes[link.target]
    if source.submap != target.submap:
        return source.recording != target.recording or is_reachable(link, keyframes)
    return link.match.target_from_source.is_same(
        target.cam_from_world @ source.cam_from_world.inverse(),
        0.5 + _max_drift(_between(keyframes, link.source, link.target)),
        np.deg2rad(max_drift_deg),
    )


def is_distinct(
    link: Link, keyframes: Sequence[KeyFrame], repeated: dict[int, int], least: int = 30
) -> bool:
    """Return whether a match exceeds the repetitions within its two images and those around. Within
    a sub-map the motion tells them apart. `repeated` caches their numbers, 0 below `least`.
    """
    max_repeated_share = 0.3  # of the matches
    num_around = 3  # key frames before and after each image
    if keyframes[link.source].submap == keyframes[link.target].submap:
        return True
    rivals = 0
    for end in (link.source, link.target):
        for i in range(max(end - num_around, 0), min(end + num_around + 1, len(keyframes))):
            one = keyframes[i]
            if one.submap == keyframes[end].submap and one.has_place:
                if i not in repeated:
                    repeated[i] = find_repetition(one.place, one.stereo, least)[0]
                rivals = max(rivals, repeated[i])
    return rivals < max(max_repeated_share * len(link.match.source_rows), 1.0)


def is_reachable(link: Link, keyframes: Sequence[KeyFrame]) -> bool:
    """Return whether a link within a recording agrees with the camera's motion.

    From the end of the earlier sub-map to the start of the later one the camera passes the sub-maps
    between them, whose motion is known. In the gaps it goes on as before, give or take a reach.
    """
    # Reach in a gap: half a metre, ten degrees, and the way at twice the maximum speed on both
    # sides of it. So the camera may have turned back at once.
    start, max_speedup = np.array([0.5, np.deg2rad(10.0)]), 2.0
    source, target = keyframes[link.source], keyframes[link.target]
    target_from_source = link.match.target_from_source
    if source.submap > target.submap:
        source, target, target_from_source = target, source, target_from_source.inverse()
    ordered = sorted(keyframes, key=lambda k: k.submap)
    passed = (k for k in ordered if source.submap <= k.submap <= target.submap)
    submaps = [list(own) for _, own in groupby(passed, lambda k: k.submap)]
    expected = source.cam_from_world @ submaps[0][-1].cam_from_world.inverse()
    reaches, turns = list[float](), list[float]()
    max_speeds = [_max_speeds(submap) for submap in submaps]
    for (before, after), speeds in zip(pairwise(submaps), pairwise(max_speeds), strict=True):
        seconds = 1e-9 * (after[0].t_ns - before[-1].t_ns)
        metres, radians = start + max_speedup * seconds * np.maximum(*speeds)
        reaches.append(metres)
        turns.append(radians)
        expected = expected @ Rigid3(np.eye(3), seconds * _last_velocity(before))
        if after is not submaps[-1]:
            motion = after[0].cam_from_world @ after[-1].cam_from_world.inverse()
            expected = expected @ motion
            chord = 2.0 * np.sin(min(np.linalg.norm(turns), np.pi) / 2.0)
            reaches.append(chord * float(np.linalg.norm(motion.translation)) + _max_drift(after))
    target_from_start = target.cam_from_world @ submaps[-1][0].cam_from_world.inverse()
    apart = expected.translation - (target_from_source.inverse() @ target_from_start).translation
    return bool(np.linalg.norm(apart) < np.linalg.norm(reaches))  # they are independent


def _max_speeds(submap: Sequence[KeyFrame]) -> Float[np.ndarray, " 2"]:
    """Return the maximum speeds within a sub-map, metres and radians per second."""
    seconds = np.maximum(1e-9 * np.diff([k.t_ns for k in submap]), 1e-9)
    return np.max(compute_steps(submap) / seconds, axis=1, initial=0.0)


def _last_velocity(submap: Sequence[KeyFrame]) -> Float[np.ndarray, " 3"]:
    """Return the velocity at the end of a sub-map, metres per second in the last camera. It is zero
    if that has one key frame."""
    a, b = submap[-2:] if len(submap) > 1 else (submap[-1], submap[-1])
    moved = b.cam_from_world.apply(a.cam_from_world.inverse().translation)
    return -moved / max(1e-9 * (b.t_ns - a.t_ns), 1e-9)


def _max_drift(passed: Sequence[KeyFrame]) -> float:
    """Return the maximum drift (metres) of the odometry along key frames of a sub-map."""
    drift_share = 0.05  # of the travelled distance
    return drift_share * float(compute_steps(passed)[0].sum())


def _between(keyframes: Sequence[KeyFrame], one: int, other: int) -> list[KeyFrame]:
    """Return two key frames of a sub-map and those between them."""
    first, last = sorted((one, other))
    return [k for k in keyframes[first : last + 1] if k.submap == keyframes[first].submap]


def _is_contradicting(other: Link, link: Link, keyframes: Sequence[KeyFrame]) -> bool:
    """Return whether another link of the same key frame contradicts this one with nearly as many
    matches."""
    # A link is rejected if another link of the same place has this share of its matches and
    # contradicts it.
    rival_share = 0.5
    if (other.target == link.target) == (other.source == link.source):
        return False
    if len(other.match.source_rows) < rival_share * len(link.match.source_rows):
        return False
    end = "source" if other.target == link.target else "target"
    drift = _max_drift(_between(keyframes, getattr(link, end), getattr(other, end)))
    return _are_consistent(other, link, keyframes, drift) is False


def _rival_pairs(
    link: Link, keyframes: Sequence[KeyFrame], places: list[int]
) -> list[tuple[int, int]]:
    """Return the pairs (target, source) of a link's target and the neighbours of its source."""
    rival_places = 15  # before and after the link's own that are searched for contradicting links
    at = places.index(link.source)
    around = places[max(at - rival_places, 0) : at + rival_places + 1]
    submap = keyframes[link.source].submap
    return [
        (link.target, source)
        for source in around
        if source not in (link.source, link.target) and keyframes[source].submap == submap
    ]


def _is_rival(rival: Link | None, link: Link, keyframes: Sequence[KeyFrame]) -> bool:
    """Return whether the target also matches a neighbour of the source, at another relative
    pose."""
    return (
        rival is not None
        and _is_within_drift(rival, keyframes)
        and _is_contradicting(rival, link, keyframes)
    )


def match_keyframes(
    source: int,
    target: int,
    keyframes: Sequence[KeyFrame],
    min_inliers: int = 25,
    min_inlier_share: float = 0.35,
) -> Link | None:
    """Link two key frames by their matches. None if too few of them agree (`match_places`)."""
    a, b = keyframes[source], keyframes[target]
    match = match_places(a.place, b.place, b.stereo, min_inliers, min_inlier_share)
    return None if match is None else Link(source, target, match)


def _is_supporting(
    other: Link, link: Link, keyframes: Sequence[KeyFrame], rank: dict[int, int]
) -> bool:
    """Return whether a link of other key frames nearby agrees."""
    near = 5  # A link supports another one if its ends are within this many places
    return (
        other.target != link.target
        and abs(rank[other.target] - rank[link.target]) <= near
        and abs(rank[other.source] - rank[link.source]) <= near
        and _are_consistent(other, link, keyframes) is True
    )


def _are_consistent(
    other: Link, link: Link, keyframes: Sequence[KeyFrame], drift: float = 0.0
) -> bool | None:
    """Return whether a round trip over both links ends near its start. None across sub-maps.

    Args:
        drift: allowed error of the odometry between them, metres.
    """
    # Maximum difference between two supporting links: metres, plus this share of the distance
    # between their ends, and degrees.
    max_disagreement, max_disagreement_deg = 0.05, 2.0
    a, b, c, d = (keyframes[i] for i in (link.source, link.target, other.source, other.target))
    if a.submap != c.submap or b.submap != d.submap:
        return None
    sources = c.cam_from_world @ a.cam_from_world.inverse()
    targets = d.cam_from_world @ b.cam_from_world.inverse()
    expected = targets.inverse() @ other.match.target_from_source @ sources
    way = sum(float(np.linalg.norm(one.translation)) for one in (sources, targets, expected))
    return link.match.target_from_source.is_same(
        expected, max_disagreement * (1.0 + way) + drift, np.deg2rad(max_disagreement_deg)
    )
