"""Loops: key frames that see a place that another one, long before or in another recording, has
seen.

The coarse place search proposes, local features and PnP verify (`place_matching`), and three guards
keep what is left from ruining the map: within a sub-map a link may not ask for more drift than the
odometry can have, none beside it may say otherwise as well as it does (of equal panels, one is as
good as the next), and a second one beside it must say the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from topoloc.bounds import Above, AtLeast, Between
from topoloc.disk_list import DiskList
from topoloc.features.features import Features
from topoloc.features.parallel import parallel_map
from topoloc.geometry.rigid import Rigid3
from topoloc.retrieval.vlad import SurfVlad, VladConfig, learn_words_from_parts, vlad
from topoloc.slam.keyframes import KeyFrame
from topoloc.slam.place_matching import PlaceMatch, PlaceMatchingConfig, match_places

_MAX_VLAD_BYTES = 4_000_000  # in memory: each is looked at once or twice, in their order


@dataclass(frozen=True)
class LoopConfig:
    """Which places are compared, and which links are believed."""

    vlad: VladConfig = field(default_factory=lambda: VladConfig(num_words=32, position_weight=0.0))
    matching: PlaceMatchingConfig = field(default_factory=PlaceMatchingConfig)
    num_candidates: Annotated[int, Between(0, 1000)] = 4
    """Places that look most alike, which each one is compared with."""
    min_places_between: Annotated[int, AtLeast(0)] = 12
    """Places nearer than this along one sub-map are no loop."""
    support_places: Annotated[int, AtLeast(0)] = 5
    """A link is supported by another one whose ends are within so many places of its own."""
    max_disagreement: Annotated[float, Above(0)] = 0.05
    """Two links that support each other may differ by this (metres), and by this share of the way
    between their ends."""
    max_disagreement_deg: Annotated[float, Above(0)] = 2.0
    """The same, in degrees."""
    rival_share: Annotated[float, Between(0, 1)] = 0.5
    """A link is contradicted by another one of the same place that has this share of its matches,
    and puts it elsewhere."""
    rival_places: Annotated[int, AtLeast(0)] = 15
    """Such links are looked for among so many places before and after its own, too."""
    max_drift: Annotated[float, AtLeast(0)] = 0.05
    """Share of the way travelled by which the odometry may be wrong, besides half a metre."""
    max_drift_deg: Annotated[float, AtLeast(0)] = 15.0
    """The same in degrees, whatever the way."""
    max_speedup: Annotated[float, Above(0)] = 2.0
    """Between two sub-maps of a recording a camera goes no faster than so many times its fastest
    within them, but for half a metre."""


@dataclass(frozen=True, eq=False)
class Link:
    """Key frames `source` and `target` (rows of the list of all) see the same place."""

    source: int
    target: int
    match: PlaceMatch


def find_links(
    keyframes: Sequence[KeyFrame],
    config: LoopConfig,
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> list[Link]:
    """All links that passed the guards, in the order of their targets."""
    places = [i for i, keyframe in enumerate(keyframes) if keyframe.has_place]
    if len(places) < 2:
        return []
    proposals = _propose_pairs(keyframes, places, config)
    links = []
    for done, link in enumerate(
        parallel_map(lambda pair: _match_keyframes(pair[1], pair[0], keyframes, config), proposals)
    ):
        if link is not None:
            links.append(link)
        progress("loops", done + 1, len(proposals))
    rank = {keyframe: place for place, keyframe in enumerate(places)}
    plausible = [link for link in links if _is_within_drift(link, keyframes, config)]
    clear = [
        link
        for link in plausible
        if not any(_is_contradicting(other, link, keyframes, config) for other in plausible)
    ]
    supported = [
        link
        for link in clear
        if any(_is_supporting(other, link, keyframes, rank, config) for other in clear)
    ]
    are_rivalled = parallel_map(lambda link: _has_rival(link, keyframes, places, config), supported)
    sure = [
        link for link, is_rivalled in zip(supported, are_rivalled, strict=True) if not is_rivalled
    ]
    return [
        link
        for link in sure
        if any(_is_supporting(other, link, keyframes, rank, config) for other in sure)
    ]


def _propose_pairs(
    keyframes: Sequence[KeyFrame], places: list[int], config: LoopConfig
) -> list[tuple[int, int]]:
    """(target, source) of pairs that look alike, source the earlier one."""
    pairs, num = (
        set(),
        config.num_candidates + 2 * config.min_places_between,
    )  # itself and its neighbours may come first
    for number, ranked in enumerate(rank_places([keyframes[i] for i in places], config.vlad, num)):
        others = (
            other
            for other in ranked
            if _is_loop_candidate(keyframes, places, other, number, config)
        )
        for _, other in zip(range(config.num_candidates), others, strict=False):
            pairs.add((places[max(number, other)], places[min(number, other)]))
    return sorted(pairs)


def rank_places(
    keyframes: Sequence[KeyFrame], config: VladConfig, num: int | None = None
) -> Iterator[list[int]]:
    """For each key frame, which must have places, the `num` of them (rows; else all) that look most
    like it, in this order; nothing where there are no features.
    """

    def features(row: int) -> Features:
        place = keyframes[row].place
        assert place is not None
        return place.features

    num_features = [len(features(row)) for row in range(len(keyframes))]
    if sum(num_features) == 0:
        return
    words = learn_words_from_parts(num_features, lambda row: features(row).descriptors, config)
    vlads = DiskList(
        (vlad(features(row).descriptors, words) for row in range(len(keyframes))), _MAX_VLAD_BYTES
    )
    localizer, blank = (
        SurfVlad.fit(words, vlads, np.arange(len(keyframes)), config),
        np.zeros((1, 1), np.uint8),
    )
    for row in range(len(keyframes)):
        yield [
            score.node_id for score in localizer.rank(blank, features(row), num or len(keyframes))
        ]


def _is_loop_candidate(
    keyframes: Sequence[KeyFrame], places: list[int], a: int, b: int, config: LoopConfig
) -> bool:
    same = keyframes[places[a]].submap == keyframes[places[b]].submap
    return a != b and (not same or abs(a - b) >= config.min_places_between)


def _is_within_drift(link: Link, keyframes: Sequence[KeyFrame], config: LoopConfig) -> bool:
    source, target = keyframes[link.source], keyframes[link.target]
    if source.submap != target.submap:
        return source.recording != target.recording or is_reachable(link, keyframes, config)
    way = _path_length(keyframes, link.source, link.target)
    drift = _pose_difference(
        link.match.target_from_source, target.cam_from_world @ source.cam_from_world.inverse()
    )
    return bool(
        drift[0] < 0.5 + config.max_drift * way and drift[1] < np.deg2rad(config.max_drift_deg)
    )


def is_reachable(link: Link, keyframes: Sequence[KeyFrame], config: LoopConfig) -> bool:
    """Whether the camera can have come from the end of the earlier sub-map to the beginning of the
    later one, as the link has it."""
    source, target, target_from_source = (
        keyframes[link.source],
        keyframes[link.target],
        link.match.target_from_source,
    )
    if source.submap > target.submap:
        source, target, target_from_source = target, source, target_from_source.inverse()
    before, after = ([k for k in keyframes if k.submap == end.submap] for end in (source, target))
    end_in_source = source.cam_from_world @ before[-1].cam_from_world.inverse()
    start_in_target = target.cam_from_world @ after[0].cam_from_world.inverse()
    start_in_source = target_from_source.inverse() @ start_in_target
    seconds = 1e-9 * (after[0].t_ns - before[-1].t_ns)
    reach = 0.5 + config.max_speedup * max(_max_speed(before), _max_speed(after)) * seconds
    return bool(np.linalg.norm(end_in_source.translation - start_in_source.translation) < reach)


def _max_speed(submap: Sequence[KeyFrame]) -> float:
    """Metres a second."""
    positions = np.array([k.cam_from_world.inverse().translation for k in submap])
    seconds = 1e-9 * np.diff([k.t_ns for k in submap])
    return float(
        np.max(
            np.linalg.norm(np.diff(positions, axis=0), axis=1) / np.maximum(seconds, 1e-9),
            initial=0.0,
        )
    )


def _path_length(keyframes: Sequence[KeyFrame], first: int, last: int) -> float:
    """Metres between two key frames of the same sub-map, along the way."""
    submap, (first, last) = keyframes[first].submap, sorted((first, last))
    between = [
        k.cam_from_world.inverse().translation
        for k in keyframes[first : last + 1]
        if k.submap == submap
    ]
    return float(np.linalg.norm(np.diff(between, axis=0), axis=1).sum())


def _is_contradicting(
    other: Link, link: Link, keyframes: Sequence[KeyFrame], config: LoopConfig
) -> bool:
    """Whether one of the link's ends is linked nearly as well with another place, and cannot be at
    both."""
    if (other.target == link.target) == (other.source == link.source):
        return False
    if len(other.match.source_rows) < config.rival_share * len(link.match.source_rows):
        return False
    ends = (
        (link.source, other.source) if other.target == link.target else (link.target, other.target)
    )
    drift = config.max_drift * _path_length(keyframes, min(ends), max(ends))
    return _are_consistent(other, link, keyframes, config, drift) is False


def _has_rival(
    link: Link, keyframes: Sequence[KeyFrame], places: list[int], config: LoopConfig
) -> bool:
    """Whether the target looks as if it were near a neighbour of the source, somewhere else."""
    at = places.index(link.source)
    around = places[max(at - config.rival_places, 0) : at + config.rival_places + 1]
    for source in (
        i
        for i in around
        if i not in (link.source, link.target)
        and keyframes[i].submap == keyframes[link.source].submap
    ):
        match = _match_keyframes(source, link.target, keyframes, config)
        if (
            match is not None
            and _is_within_drift(match, keyframes, config)
            and _is_contradicting(match, link, keyframes, config)
        ):
            return True
    return False


def _match_keyframes(
    source: int, target: int, keyframes: Sequence[KeyFrame], config: LoopConfig
) -> Link | None:
    a, b = keyframes[source].place, keyframes[target].place
    assert a is not None
    assert b is not None
    match = match_places(a, b, keyframes[target].stereo, config.matching)
    return None if match is None else Link(source, target, match)


def _is_supporting(
    other: Link, link: Link, keyframes: Sequence[KeyFrame], rank: dict[int, int], config: LoopConfig
) -> bool:
    """Whether a link of other key frames nearby says the same."""
    if other is link or other.target == link.target:
        return False
    near = config.support_places
    if (
        abs(rank[other.target] - rank[link.target]) > near
        or abs(rank[other.source] - rank[link.source]) > near
    ):
        return False
    return _are_consistent(other, link, keyframes, config) is True


def _are_consistent(
    other: Link, link: Link, keyframes: Sequence[KeyFrame], config: LoopConfig, drift: float = 0.0
) -> bool | None:
    """Whether going from source to target by the one link and back by the other ends where it
    began; None across sub-maps.

    Args:
        drift: metres by which the odometry may be wrong between them.
    """
    a, b, c, d = (keyframes[i] for i in (link.source, link.target, other.source, other.target))
    if a.submap != c.submap or b.submap != d.submap:
        return None
    sources, targets = (
        c.cam_from_world @ a.cam_from_world.inverse(),
        d.cam_from_world @ b.cam_from_world.inverse(),
    )
    expected = targets.inverse() @ other.match.target_from_source @ sources
    way = float(
        np.linalg.norm(sources.translation)
        + np.linalg.norm(targets.translation)
        + np.linalg.norm(expected.translation)
    )
    metres, radians = _pose_difference(link.match.target_from_source, expected)
    return bool(
        metres < config.max_disagreement * (1.0 + way) + drift
        and radians < np.deg2rad(config.max_disagreement_deg)
    )


def _pose_difference(a: Rigid3, b: Rigid3) -> tuple[float, float]:
    """Metres and radians."""
    return float(np.linalg.norm(a.translation - b.translation)), (a @ b.inverse()).angle()
