"""Test the weights of evidence: more of it never lowers the odds, and neither a count nor precision
alone suffices."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from topoloc.localization.config import EvidenceConfig
from topoloc.localization.evidence import (
    compute_inlier_spread,
    compute_normalized_uncertainty,
    compute_translation_tolerance,
    compute_uniform_inlier_ratio,
    is_only_imprecise,
)
from topoloc.localization.fitted_weights import FittedWeights, load_fitted_weights
from topoloc.localization.provenance import Evidence

CONFIG, WEIGHTS = EvidenceConfig(), load_fitted_weights("surf")
STRONG = Evidence(
    num_matches=150,
    num_inliers=90,
    num_found=300,
    num_visible=1700,
    num_by_chance=20,
    spread=0.8,
    doubt=0.1,
    even_share=0.15,
)
# Peers accept this pose for its inliers, though nearly all predicted points are missing, and chance
# finds as many.
MANY_OF_VERY_MANY = Evidence(
    num_matches=40,
    num_inliers=6,
    num_found=70,
    num_visible=2000,
    num_by_chance=60,
    spread=0.5,
    doubt=0.3,
    even_share=0.02,
)

counts = st.integers(0, 2000)
evidences = st.builds(
    Evidence,
    counts,
    counts,
    counts,
    counts,
    counts,
    st.floats(0.0, 1.0, allow_nan=False),
    st.floats(0.0, 1e3, allow_nan=False),
    st.floats(0.0, 1.0, allow_nan=False),
    st.none() | counts,
)


def _probability(evidence: Evidence, weights: FittedWeights) -> float:
    """Return the probability of this pose against "nowhere in the map"."""
    return 1.0 / (1.0 + math.exp(-weights.log_odds(evidence)))


@given(evidences)
def test_more_evidence_never_lowers_the_probability(evidence: Evidence):
    log_odds = WEIGHTS.log_odds(evidence)
    assert math.isfinite(log_odds)
    for better in (
        replace(evidence, num_found=evidence.num_found + 5),
        replace(evidence, spread=min(evidence.spread + 0.1, 1.0)),
        replace(evidence, even_share=min(evidence.even_share + 0.01, 1.0)),
        replace(evidence, num_inliers=evidence.num_inliers + 1),
    ):
        assert WEIGHTS.log_odds(better) >= log_odds
    for worse in (
        replace(evidence, num_by_chance=evidence.num_by_chance + 5),
        replace(evidence, num_matches=evidence.num_matches + 5),
        replace(evidence, doubt=evidence.doubt * 2.0),
    ):
        assert WEIGHTS.log_odds(worse) <= log_odds


def test_strong_evidence_is_accepted():
    assert _probability(STRONG, WEIGHTS) > 0.97


def test_many_matches_of_very_many_visible_points_are_improbable():
    assert _probability(MANY_OF_VERY_MANY, WEIGHTS) < 0.3


@pytest.mark.parametrize(
    "weaker",
    [
        {"num_by_chance": 300, "num_inliers": 12},
        {"num_found": 40, "num_inliers": 12, "spread": 0.1},
        {"num_inliers": 5, "num_matches": 60, "num_found": 60},
        {"doubt": 8.0, "num_inliers": 12, "num_found": 90},
    ],
)
def test_no_single_part_of_the_evidence_carries_a_pose(weaker: dict[str, float]):
    assert _probability(replace(STRONG, **weaker), WEIGHTS) < 0.7


def test_an_imprecise_pose_is_distinguished_from_one_without_evidence():
    small = replace(
        STRONG,
        num_inliers=24,
        num_matches=40,
        num_found=110,
        num_by_chance=12,
        spread=0.2,
        doubt=30.0,
        even_share=0.08,
    )
    assert _probability(small, WEIGHTS) < CONFIG.min_probability
    assert is_only_imprecise(small, WEIGHTS.log_odds(small), WEIGHTS, CONFIG)
    assert not is_only_imprecise(
        MANY_OF_VERY_MANY, WEIGHTS.log_odds(MANY_OF_VERY_MANY), WEIGHTS, CONFIG
    )


def test_indoors_less_is_tolerated():
    assert compute_translation_tolerance(20.0, CONFIG) == 0.25
    assert compute_translation_tolerance(2.0, CONFIG) == pytest.approx(0.1)


def test_a_wider_tolerance_forgives_a_lack_of_precision_but_proves_no_place():
    wide = replace(CONFIG, tolerance=(0.5, 4.0))
    for doubt, forgiven in ((1.0, 0.5), (0.4, 0.3), (0.2, 0.2)):
        metres = np.diag([1e-9, (0.25 * doubt) ** 2, 1e-9, 1e-12, 1e-12, 1e-12])
        assert compute_normalized_uncertainty(metres, 20.0, wide) == pytest.approx(forgiven, 1e-2)


def test_normalized_uncertainty_is_one_at_the_tolerance_in_the_worst_direction():
    metres = np.diag([1e-6, 0.25**2, 1e-6, 1e-12, 1e-12, 1e-12])
    radians = np.diag([1e-12, 1e-12, 1e-12, 1e-9, 1e-9, np.deg2rad(2.0) ** 2])
    assert compute_normalized_uncertainty(metres, 20.0, CONFIG) == pytest.approx(1.0, abs=1e-3)
    assert compute_normalized_uncertainty(radians, 20.0, CONFIG) == pytest.approx(1.0, abs=1e-3)
    assert compute_normalized_uncertainty(metres, 2.0, CONFIG) == pytest.approx(2.5, abs=1e-3)


def test_spread_counts_cells_not_points():
    corner = np.random.default_rng(0).uniform(0.0, 20.0, (500, 2))
    everywhere = (
        np.stack(np.meshgrid(np.arange(40, 640, 80), np.arange(40, 480, 80)), axis=-1)
        .reshape(-1, 2)
        .astype(np.float64)
    )
    assert compute_inlier_spread(corner, 640, 480) == pytest.approx(1 / 48)
    assert compute_inlier_spread(everywhere, 640, 480) == 1.0
    assert compute_inlier_spread(
        np.array([[-0.5, -0.5], [639.5, 479.5]]), 640, 480
    ) == pytest.approx(2 / 48)


def test_points_found_everywhere_are_more_uniform_than_in_one_half():
    visible = np.random.default_rng(0).uniform([0.0, 0.0], [640.0, 480.0], (2000, 2))
    everywhere, in_left_half = visible[:200], visible[visible[:, 0] < 320.0][:200]
    even, uneven = (
        compute_uniform_inlier_ratio(everywhere, visible, 640, 480),
        compute_uniform_inlier_ratio(in_left_half, visible, 640, 480),
    )
    assert even == pytest.approx(0.1, rel=0.15)
    assert uneven < 0.6 * even
    assert compute_uniform_inlier_ratio(np.zeros((0, 2)), visible, 640, 480) < 0.02
    assert compute_uniform_inlier_ratio(everywhere, np.zeros((0, 2)), 640, 480) == 0.0


OF_WALLS = Evidence(
    num_matches=150,
    num_inliers=40,
    num_found=60,
    num_visible=200,
    num_by_chance=12,
    spread=0.5,
    doubt=0.3,
    even_share=0.2,
    num_distinct=30,
)
MORE = {
    "found": replace(OF_WALLS, num_found=90),
    "less must be in view": replace(OF_WALLS, num_visible=120),
    "less by chance": replace(OF_WALLS, num_by_chance=3),
    "inliers": replace(OF_WALLS, num_inliers=60),
    "fewer matches that agree with nothing": replace(OF_WALLS, num_matches=80),
    "spread": replace(OF_WALLS, spread=0.8),
    "precise": replace(OF_WALLS, doubt=0.1),
    "distinct": replace(OF_WALLS, num_distinct=50),
}


@pytest.mark.parametrize("evidence", MORE.values(), ids=MORE.keys())
def test_more_evidence_of_virtual_views_raises_the_odds(evidence: Evidence):
    assert WEIGHTS.log_odds(evidence) > WEIGHTS.log_odds(OF_WALLS) + 0.1


def test_both_virtual_views_are_more_evidence_than_one():
    weights = load_fitted_weights("topoloc-net-sides")
    by_both, by_one = (weights.log_odds(replace(OF_WALLS, num_lesser_side=num)) for num in (30, 1))
    assert by_both > by_one + 1.0


def test_no_evidence_of_virtual_views_gives_low_odds():
    nothing = Evidence(0, 0, 0, 0, 0, spread=0.0, doubt=50.0, even_share=0.0, num_distinct=0)
    assert WEIGHTS.log_odds(nothing) < -5.0


def test_only_a_pose_of_virtual_views_needs_precision_beside_its_odds():
    assert replace(STRONG, doubt=8.0).precision_probability == 1.0
    assert replace(OF_WALLS, doubt=1.0).precision_probability == pytest.approx(
        0.6827, abs=1e-4
    )  # one standard deviation
    assert replace(OF_WALLS, doubt=0.3).precision_probability > 0.99
    assert replace(OF_WALLS, doubt=8.0).precision_probability < 0.11


@pytest.mark.parametrize("kind", ["surf", "topoloc-net"])
def test_a_narrow_part_of_the_image_is_not_certain(kind: str):
    """An image in reverse direction was localized at another door with p = .99. The door alone has
    82 matched points, in 9 of 48 cells."""
    weights = load_fitted_weights(kind)
    door = replace(STRONG, num_matches=140, num_inliers=130, even_share=0.65, num_by_chance=0)
    assert _probability(replace(door, spread=0.35), weights) > 0.95
    assert 0.5 < _probability(replace(door, spread=0.19, doubt=0.2), weights) < 0.9
    assert _probability(replace(door, spread=0.19, doubt=0.5), weights) < 0.5
    assert not weights.evidence.is_clear(weights.log_odds(replace(door, spread=0.19)))
