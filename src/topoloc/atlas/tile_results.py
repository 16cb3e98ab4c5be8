"""Merge the results of several tiles for one image.

Each tile ranks only its own poses. A pose is reported only if it leads every pose of every other
queried tile by the margin required within one map (`localization/belief.py`). Otherwise the image
is ambiguous, and the alternatives name their tiles. If the transform between two tiles is known,
equal poses are not rivals.
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
_SIGMAS = 3.0  # sigmas of a join, added to these limits, at most doubling them
_MIN_ALTERNATIVE_RATIO = 0.01


@dataclass(frozen=True, eq=False)
class TileResult:
    """Hold the result of a tile and each reported pose.

    `is_exhaustive` is True after an exhaustive search. `similarity` is the tile's rank score.
    """

    tile: Tile
    result: Localization | NotLocalized
    named: tuple[Localization, ...]
    is_exhaustive: bool
    similarity: float = 0.0

    @property
    def is_clear(self) -> bool:
        """Return whether the tile's pose is clear."""
        result = self.result
        return (
            isinstance(result, Localization)
            and _log_odds(result) > _weights(result).evidence.clear_log_odds
        )


def merge_tile_results(tile_results: Sequence[TileResult]) -> Localization | NotLocalized:
    """Merge the results of several tiles into one.

    The first reported pose of a tile represents it. If no tile localized the image, the most
    informative refusal is returned.
    """
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
    """Return whether a pose with this evidence is too improbable to be reported as an
    alternative."""
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
    """Return the poses of other tiles that differ from the pose of this tile."""
    return [
        (tile, pose)
        for tile, pose in reported_poses
        if tile is not one.tile and not _is_same_pose(one.tile, one.named[0], tile, pose)
    ]


def _ambiguous_result(
    best: TileResult, rivals: Sequence[tuple[Tile, Localization]], log_odds_margins: Sequence[float]
) -> NotLocalized:
    """Return an ambiguous result with the probability of each alternative."""
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
    """Return the most informative refusal: one with alternatives, or with the most inliers."""
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
    """Add the tile's id to a result, and the pose in the atlas and joint world if known."""
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
    """Return the log-odds margin of a pose over a pose of another tile.

    It is the difference of rival scores, which separate similar places, if both use the same
    feature type. Otherwise, or for virtual views, it is the difference of log-odds.
    """
    is_alike = a.provenance.features == b.provenance.features and not (
        a.is_from_virtual_views or b.is_from_virtual_views
    )
    return _rival_score(a) - _rival_score(b) if is_alike else _log_odds(a) - _log_odds(b)


def _rival_score(result: Localization) -> float:
    """Return the rival score of a pose, as in `belief.log_odds_margin`."""
    if result.evidence is None or result.is_from_virtual_views:
        return _log_odds(result)
    return compute_rival_score(result.evidence, _log_odds(result), _weights(result).rivals)


def _log_odds(result: Localization) -> float:
    """Return the log-odds of the pose against "not in the map"."""
    if result.evidence is None:
        return math.log(max(result.probability, 1e-9) / max(1.0 - result.probability, 1e-9))
    return compute_log_odds(result.evidence, _weights(result))


def _weights(result: Localization) -> FittedWeights:
    return load_fitted_weights(result.provenance.features)


def _is_same_pose(tile: Tile, pose: Localization, other: Tile, other_pose: Localization) -> bool:
    """Return whether poses of two tiles are the same, if the transform between the tiles is known.

    For joined tiles the tolerance includes the sigmas of the joins.
    """
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
    """Return the sigmas of the transform between two tiles at a pose: metres and radians.

    They are 0 if no join is involved.
    """
    here, there = tile.joint, other.joint
    if tile.world == other.world or here is None or there is None or here.joint != there.joint:
        return 0.0, 0.0
    return sigmas_at(
        (here.joint_from_world @ pose.world_from_cam).translation,
        here.covariance + there.covariance,
    )
