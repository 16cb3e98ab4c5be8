"""Loops: key frames that see a place that another one, long before or in another recording, has seen.

The coarse place search proposes, local features and PnP verify (`place_matching`), and two guards keep what is left from ruining
the map: a link needs a second one beside it that says the same, and within a sub-map it may not ask for more drift than the
odometry can have.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from topoloc.bounds import Above, AtLeast, Between
from topoloc.geometry.rigid import Rigid3
from topoloc.places.vlad import SurfVlad, VladConfig, learn_words, vlad
from topoloc.slam.keyframes import KeyFrame
from topoloc.slam.place_matching import PlaceMatch, PlaceMatchingConfig, match_places


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
    """Two links that support each other may differ by this (metres), and by this share of the way between their ends."""
    max_disagreement_deg: Annotated[float, Above(0)] = 2.0
    """The same, in degrees."""
    max_drift: Annotated[float, AtLeast(0)] = 0.05
    """Share of the way travelled by which the odometry may be wrong, besides half a metre."""
    max_drift_deg: Annotated[float, AtLeast(0)] = 15.0
    """The same in degrees, whatever the way."""


@dataclass(frozen=True, eq=False)
class Link:
    """Key frames `source` and `target` (rows of the list of all) see the same place."""

    source: int
    target: int
    match: PlaceMatch


def find_links(
    keyframes: Sequence[KeyFrame], config: LoopConfig, progress: Callable[[str, int, int], None] = lambda stage, done, total: None
) -> list[Link]:
    """All links that passed the guards, in the order of their targets."""
    places = [i for i, keyframe in enumerate(keyframes) if keyframe.place is not None]
    if len(places) < 2:
        return []
    proposals = _propose(keyframes, places, config)
    links = []
    for done, (target, source) in enumerate(proposals):
        a, b = keyframes[source].place, keyframes[target].place
        assert a is not None
        assert b is not None
        match = match_places(a, b, keyframes[target].stereo, config.matching)
        if match is not None:
            links.append(Link(source, target, match))
        progress("loops", done + 1, len(proposals))
    plausible = [link for link in links if _within_drift(link, keyframes, config)]
    rank = {keyframe: place for place, keyframe in enumerate(places)}
    return [link for link in plausible if any(_supports(other, link, keyframes, rank, config) for other in plausible)]


def _propose(keyframes: Sequence[KeyFrame], places: list[int], config: LoopConfig) -> list[tuple[int, int]]:
    """(target, source) of pairs that look alike, source the earlier one."""
    features = [place.features for i in places if (place := keyframes[i].place) is not None]
    descriptors = np.concatenate([f.descriptors for f in features])
    if len(descriptors) == 0:
        return []
    words = learn_words(descriptors, config.vlad)
    localizer = SurfVlad.fit(words, np.stack([vlad(f.descriptors, words) for f in features]), np.arange(len(places)), config.vlad)
    blank = np.zeros((1, 1), np.uint8)
    pairs = set()
    for number, own in enumerate(features):
        ranked = localizer.rank(blank, own, len(places))
        others = (score.node_id for score in ranked if _may_be_loop(keyframes, places, score.node_id, number, config))
        for _, other in zip(range(config.num_candidates), others, strict=False):
            pairs.add((places[max(number, other)], places[min(number, other)]))
    return sorted(pairs)


def _may_be_loop(keyframes: Sequence[KeyFrame], places: list[int], a: int, b: int, config: LoopConfig) -> bool:
    same = keyframes[places[a]].submap == keyframes[places[b]].submap
    return a != b and (not same or abs(a - b) >= config.min_places_between)


def _within_drift(link: Link, keyframes: Sequence[KeyFrame], config: LoopConfig) -> bool:
    source, target = keyframes[link.source], keyframes[link.target]
    if source.submap != target.submap:
        return True
    between = [k.cam_from_world.inverse().translation for k in keyframes[link.source : link.target + 1] if k.submap == source.submap]
    way = float(np.linalg.norm(np.diff(between, axis=0), axis=1).sum())
    drift = _difference(link.match.target_from_source, target.cam_from_world @ source.cam_from_world.inverse())
    return bool(drift[0] < 0.5 + config.max_drift * way and drift[1] < np.deg2rad(config.max_drift_deg))


def _supports(other: Link, link: Link, keyframes: Sequence[KeyFrame], rank: dict[int, int], config: LoopConfig) -> bool:
    """Whether going from source to target by the one link and back by the other ends where it began."""
    if other is link or other.target == link.target:
        return False
    near = config.support_places
    if abs(rank[other.target] - rank[link.target]) > near or abs(rank[other.source] - rank[link.source]) > near:
        return False
    a, b, c, d = (keyframes[i] for i in (link.source, link.target, other.source, other.target))
    if a.submap != c.submap or b.submap != d.submap:
        return False
    sources, targets = c.cam_from_world @ a.cam_from_world.inverse(), d.cam_from_world @ b.cam_from_world.inverse()
    expected = targets.inverse() @ other.match.target_from_source @ sources
    way = float(np.linalg.norm(sources.translation) + np.linalg.norm(targets.translation) + np.linalg.norm(expected.translation))
    metres, radians = _difference(link.match.target_from_source, expected)
    return bool(metres < config.max_disagreement * (1.0 + way) and radians < np.deg2rad(config.max_disagreement_deg))


def _difference(a: Rigid3, b: Rigid3) -> tuple[float, float]:
    """Metres and radians."""
    return float(np.linalg.norm(a.translation - b.translation)), (a @ b.inverse()).angle()
