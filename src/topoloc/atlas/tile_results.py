"""What several tiles say of one picture, heard together.

Each tile weighs its own poses and knows nothing of the others. A pose is believed only where it
leads every pose of every other tile that was asked, by the same evidence and by as much as two
poses of one map must be apart (`localization/belief.py`). Else the picture is ambiguous, and the
alternatives name their tiles. Where the atlas knows how two tiles lie to each other, poses that are
the same one are no rivals.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from topoloc.atlas.joins import sigmas_at
from topoloc.atlas.manifest import Tile
from topoloc.localization.belief import MIN_LOG_ODDS_MARGIN
from topoloc.localization.evidence import Evidence, compute_log_odds, compute_rival_score
from topoloc.localization.fitted_weights import FittedWeights, load_fitted_weights
from topoloc.localization.result import Alternative, Localization, NotLocalized, R

_SAME_METRES, _SAME_DEG = 1.0, 5.0
_SIGMAS = 3.0  # of a join, which add to these; at most as much again
_MIN_ALTERNATIVE_RATIO = 0.01


@dataclass(frozen=True, eq=False)
class TileResult:
    """What a tile said: its result, and each pose that this names. `is_exhaustive`: was it asked by
    all means?"""

    tile: Tile
    result: Localization | NotLocalized
    named: tuple[Localization, ...]
    is_exhaustive: bool
    similarity: float = 0.0

    @property
    def is_clear(self) -> bool:
        """Is its pose so well founded that the map itself asked no further?"""
        result = self.result
        return (
            isinstance(result, Localization)
            and _log_odds(result) > _weights(result).evidence.clear_log_odds
        )


def merge_tile_results(tile_results: Sequence[TileResult]) -> Localization | NotLocalized:
    """The answer of several tiles; the first one of a tile speaks for it. Of refusals the one that
    found most."""
    reported_poses = [(one.tile, pose) for one in tile_results for pose in one.named]
    found = [
        one for one in tile_results if isinstance(one.result, Localization) and one.is_exhaustive
    ]
    if not found:
        return _best_refusal(tile_results)
    best = max(
        found,
        key=lambda one: min(
            (_log_odds_margin(one.named[0], pose) for _, pose in _rivals_of(one, reported_poses)),
            default=math.inf,
        ),
    )
    assert isinstance(best.result, Localization)
    rivals = _rivals_of(best, reported_poses)
    log_odds_margins = [_log_odds_margin(best.result, pose) for _, pose in rivals]
    if all(by >= MIN_LOG_ODDS_MARGIN for by in log_odds_margins):
        others = (
            (1.0 / best.result.probability) - 1.0 + sum(math.exp(-by) for by in log_odds_margins)
        )
        return with_tile(replace(best.result, probability=1.0 / (1.0 + others)), best.tile)
    return _ambiguous_result(best, rivals, log_odds_margins)


def is_negligible_rival(evidence: Evidence, features: str, answer: Localization) -> bool:
    """Would a pose of another tile with this evidence be too improbable beside the answer to be
    named as an alternative?"""
    weights = load_fitted_weights(features)
    log_odds = compute_log_odds(evidence, weights)
    is_alike = features == answer.provenance.features and not answer.is_from_virtual_views
    by = (
        _rival_score(answer) - compute_rival_score(evidence, log_odds, weights.rivals)
        if is_alike
        else _log_odds(answer) - log_odds
    )
    return by > -math.log(_MIN_ALTERNATIVE_RATIO)


def _rivals_of(
    one: TileResult, reported_poses: Sequence[tuple[Tile, Localization]]
) -> list[tuple[Tile, Localization]]:
    """The poses of other tiles that are not the same as the one of this tile."""
    return [
        (tile, pose)
        for tile, pose in reported_poses
        if tile is not one.tile and not _is_same_pose(one.tile, one.named[0], tile, pose)
    ]


def _ambiguous_result(
    best: TileResult, rivals: Sequence[tuple[Tile, Localization]], log_odds_margins: Sequence[float]
) -> NotLocalized:
    """It is one of these; how probable each is, beside "nowhere"."""
    assert isinstance(best.result, Localization)
    others = (
        (1.0 / max(best.result.probability, 1e-6))
        - 1.0
        + sum(math.exp(-by) for by in log_odds_margins)
    )
    shares = [(1.0 / (1.0 + others), best.tile, best.result)]
    shares += [
        (math.exp(-by) / (1.0 + others), tile, pose)
        for by, (tile, pose) in zip(log_odds_margins, rivals, strict=True)
    ]
    probable = sorted(
        (one for one in shares if one[0] >= _MIN_ALTERNATIVE_RATIO * shares[0][0]),
        key=lambda one: -one[0],
    )
    alternatives = tuple(
        Alternative(pose.world_from_cam, probability, pose.node_id, pose.geopose, tile.tile_id)
        for probability, tile, pose in probable
    )
    detail = f"as much like tile {alternatives[1].tile} as like tile {alternatives[0].tile}"
    result = best.result
    refusal = NotLocalized(
        "ambiguous",
        result.candidates,
        result.num_matches,
        result.num_inliers,
        {},
        detail,
        alternatives,
        result.provenance,
    )
    return with_tile(replace(refusal, seen_camera=result.seen_camera), best.tile)


def _best_refusal(tile_results: Sequence[TileResult]) -> NotLocalized:
    """That of the tile that knows most of the picture: one that has alternatives, or the most
    inliers."""
    refused = [one for one in tile_results if isinstance(one.result, NotLocalized)]
    best = max(
        refused,
        key=lambda one: (
            one.is_exhaustive,
            one.result.reason == "ambiguous",  # pyright: ignore
            one.result.num_inliers,
            one.similarity,
        ),
    )
    assert isinstance(best.result, NotLocalized)
    result = best.result
    alternatives = tuple(replace(one, tile=best.tile.tile_id) for one in result.alternatives)
    return with_tile(replace(result, alternatives=alternatives), best.tile)


def with_tile(result: R, tile: Tile) -> R:
    """A tile's answer with its name, and the pose in the atlas's world where that is known."""
    pose, joint_pose, joint = None, None, None if tile.joint is None else tile.joint.joint
    if isinstance(result, Localization) and tile.atlas_from_world is not None:
        pose = tile.atlas_from_world @ result.world_from_cam
    if isinstance(result, Localization) and tile.joint is not None:
        joint_pose = tile.joint.joint_from_world @ result.world_from_cam
    of_atlas = {
        "tile": tile.tile_id,
        "atlas_from_cam": pose,
        "joint_world": joint,
        "joint_from_cam": joint_pose,
    }
    return replace(result, provenance=replace(result.provenance, **of_atlas))


def _log_odds_margin(a: Localization, b: Localization) -> float:
    """By how much one pose is likelier than another of another tile, in logarithms of odds: by
    their strengths, which tell twins apart, where features of one kind speak for both, else by the
    odds of each."""
    is_alike = a.provenance.features == b.provenance.features and not (
        a.is_from_virtual_views or b.is_from_virtual_views
    )
    return _rival_score(a) - _rival_score(b) if is_alike else _log_odds(a) - _log_odds(b)


def _rival_score(result: Localization) -> float:
    """As of `belief.lead`."""
    if result.evidence is None or result.is_from_virtual_views:
        return _log_odds(result)
    return compute_rival_score(result.evidence, _log_odds(result), _weights(result).rivals)


def _log_odds(result: Localization) -> float:
    """Of the pose against "nowhere"."""
    if result.evidence is None:
        return math.log(max(result.probability, 1e-9) / max(1.0 - result.probability, 1e-9))
    return compute_log_odds(result.evidence, _weights(result))


def _weights(result: Localization) -> FittedWeights:
    return load_fitted_weights(result.provenance.features)


def _is_same_pose(tile: Tile, pose: Localization, other: Tile, other_pose: Localization) -> bool:
    """Do poses of two tiles say the same, as far as the atlas knows how these lie to each other? Of
    tiles that are joined this is known within the joins' sigmas."""
    world_from_other = tile.from_world_of(other)
    if world_from_other is None:
        return False
    apart = pose.world_from_cam.inverse() @ world_from_other @ other_pose.world_from_cam
    metres, radians = _join_sigmas(tile, pose, other)
    near = float(np.linalg.norm(apart.translation)) < _SAME_METRES + min(
        _SIGMAS * metres, _SAME_METRES
    )
    return near and math.degrees(apart.angle()) < _SAME_DEG + min(
        _SIGMAS * math.degrees(radians), _SAME_DEG
    )


def _join_sigmas(tile: Tile, pose: Localization, other: Tile) -> tuple[float, float]:
    """How certain the way from one tile to another is at this pose of the first: metres and
    radians; 0 where it is no matter of joins."""
    here, there = tile.joint, other.joint
    if tile.world == other.world or here is None or there is None or here.joint != there.joint:
        return 0.0, 0.0
    return sigmas_at(
        (here.joint_from_world @ pose.world_from_cam).translation,
        here.covariance + there.covariance,
    )
