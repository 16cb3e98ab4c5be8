"""Merge the results of several tiles for one image.

Each tile ranks only its own poses. A pose is reported only if it leads every pose of every other
searched tile by the margin required within one map (`localization/belief.py`). Otherwise the image
is ambiguous, and the alternatives name their tiles. If the transform between two tiles is known,
equal poses are not rivals.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from topoloc.localization.belief import MIN_LOG_ODDS_MARGIN
from topoloc.localization.evidence import compute_log_odds, compute_rival_score
from topoloc.localization.fitted_weights import FittedWeights, load_fitted_weights
from topoloc.localization.provenance import Evidence
from topoloc.localization.result import Alternative, Localization, NotLocalized
from topoloc.localization.result_decision import LocalizationWithInliers
from topoloc.localization.tiles.tiles import Tiles

_MIN_ALTERNATIVE_RATIO = 0.01


@dataclass(frozen=True, eq=False)
class TileResult:
    """Hold the result of a tile and each reported pose with its inliers.

    `is_exhaustive` is True after an exhaustive search. `similarity` is the tile's rank score.
    """

    tile_id: str
    result: Localization | NotLocalized
    poses: list[LocalizationWithInliers]
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


@dataclass(frozen=True, eq=False)
class _Rival:
    """Hold a pose of another tile and the log-odds margin of the best pose over it."""

    tile_id: str
    pose: LocalizationWithInliers
    margin: float


def merge_tile_results(
    tiles: Tiles, results: Sequence[TileResult]
) -> tuple[str, Localization | NotLocalized, list[LocalizationWithInliers]]:
    """Merge the results of several tiles into one.

    The first reported pose of a tile represents it. If no tile localized the image, the most
    informative refusal is returned.

    Returns:
        The tile of the result, the result, and its reported poses.
    """
    if len(results) == 1:
        return results[0].tile_id, results[0].result, results[0].poses
    localized = [
        (one, found, _rivals(tiles, one, found, results))
        for one in results
        if one.is_exhaustive and isinstance(found := one.result, Localization)
    ]
    if not localized:
        return _best_refusal(results)
    best, found, rivals = max(
        localized, key=lambda one: min((rival.margin for rival in one[2]), default=math.inf)
    )
    if not rivals:
        return best.tile_id, found, best.poses
    others = 1.0 / max(found.probability, 1e-6) - 1.0
    others += sum(math.exp(-rival.margin) for rival in rivals)
    if all(rival.margin >= MIN_LOG_ODDS_MARGIN for rival in rivals):
        found = replace(found, probability=1.0 / (1.0 + others))
        return best.tile_id, found, [(found, seen) for _, seen in best.poses]
    return best.tile_id, *_ambiguous_result(best, found, rivals, others)


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


def _rivals(
    tiles: Tiles, one: TileResult, found: Localization, results: Sequence[TileResult]
) -> list[_Rival]:
    """Return the poses of other tiles that differ from the pose of this tile."""
    return [
        _Rival(other.tile_id, pose, _log_odds_margin(found, pose[0]))
        for other in results
        if other is not one
        for pose in other.poses
        if not tiles.may_be_same_pose(one.tile_id, found, other.tile_id, pose[0])
    ]


def _ambiguous_result(
    best: TileResult, found: Localization, rivals: Sequence[_Rival], others: float
) -> tuple[NotLocalized, list[LocalizationWithInliers]]:
    """Return an ambiguous result with the probability of each alternative."""
    shares = [(1.0 / (1.0 + others), best.tile_id, best.poses[0])]
    shares += [(math.exp(-one.margin) / (1.0 + others), one.tile_id, one.pose) for one in rivals]
    probable = sorted(
        (one for one in shares if one[0] >= _MIN_ALTERNATIVE_RATIO * shares[0][0]),
        key=lambda one: -one[0],
    )
    alternatives = tuple(
        Alternative(pose.world_from_cam, probability, pose.node_id, pose.geopose, tile_id)
        for probability, tile_id, (pose, _) in probable
    )
    detail = f"as much like tile {alternatives[1].tile} as like tile {alternatives[0].tile}"
    refusal = NotLocalized(
        "ambiguous",
        found.candidates,
        found.num_matches,
        found.num_inliers,
        {},
        detail,
        alternatives,
        found.provenance,
        found.seen_camera,
    )
    return refusal, [
        (replace(pose, probability=probability), seen) for probability, _, (pose, seen) in probable
    ]


def _best_refusal(
    results: Sequence[TileResult],
) -> tuple[str, NotLocalized, list[LocalizationWithInliers]]:
    """Return the most informative refusal: one with alternatives, or with the most inliers."""
    refused = [(one, result) for one in results if isinstance(result := one.result, NotLocalized)]
    best, result = max(
        refused,
        key=lambda one: (
            one[0].is_exhaustive,
            one[1].reason == "ambiguous",
            one[1].num_inliers,
            one[0].similarity,
        ),
    )
    return best.tile_id, result, best.poses


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
