"""Test the fit of weights: known weights are recovered from drawn poses, poses are labelled, and
the command writes a valid file."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec import json, structs

from topoloc.localization.fitted_weights import (
    CorrelatedErrorWeights,
    EvidenceWeights,
    FittedWeights,
    NodeStop,
    RivalWeights,
    compute_log_odds,
    load_fitted_weights,
    read_weights,
)
from topoloc.localization.localizer import Localizer
from topoloc.localization.provenance import Evidence
from topoloc.recordings.open import open_sequence
from topoloc_paper.fit import __main__ as command
from topoloc_paper.fit.corpus import AskedPlace
from topoloc_paper.fit.evidence import (
    Judged,
    best_strength,
    calibration_error,
    decided,
    fit_evidence,
    fit_shared_errors,
    judged,
    try_on_others,
)
from topoloc_paper.fit.rivals import MIN_HARD_PAIRS, fit_rivals, num_mistaken, pairs_of
from topoloc_paper.fit.tried_poses import TriedPose, ask_place, load_poses, save_poses
from topoloc_paper.fit.walls import MIN_POSES, fit_walls

TRUE = EvidenceWeights(
    even_share=2.0,
    chance=1.0,
    inliers=0.3,
    inlier_share=1.5,
    spread=0.5,
    doubt=-0.5,
    bias=7.0,
    clear_log_odds=4.5,
    narrow_spread=0.0,
)
PRIOR = structs.replace(TRUE, even_share=1.0, inliers=1.0, bias=4.0)
RIGHT, WRONG, BETWEEN = (0.01, 0.2), (3.0, 5.0), (0.3, 5.0)
MAPS = ("corridor_map", "demo/map_lap1", "seven_scenes/kitchen@0-59/100")


def _pose(
    error: tuple[float, float] | None, evidence: Evidence, index: int = 0, mapping: str = MAPS[0]
) -> TriedPose:
    metres, degrees = error or (None, None)
    return TriedPose(
        mapping,
        mapping,
        index,
        "as it is",
        metres,
        degrees,
        8.0,
        evidence,
        None,
        6.0 if error else None,
        0.02,
    )


def _evidence(rng: np.random.Generator) -> Evidence:
    visible = int(rng.integers(200, 1500))
    found = int(visible * rng.beta(1.0, 4.0)) + 12
    matches = int(rng.integers(10, 200))
    inliers = int(matches * rng.beta(1.0, 2.0))
    spread, doubt, even = (
        rng.uniform(0.05, 0.9),
        rng.lognormal(-1.0, 1.0),
        float(rng.beta(1.0, 8.0)),
    )
    return Evidence(
        matches,
        inliers,
        found,
        visible,
        int(rng.integers(0, 60)),
        float(spread),
        float(doubt),
        even,
    )


def _drawn(num: int, seed: int = 0) -> list[TriedPose]:
    """Draw poses, each right with the probability that `TRUE` gives it. Wrong ones are of
    the place itself."""
    rng, poses = np.random.default_rng(seed), []
    for k in range(num):
        evidence = _evidence(rng)
        is_right = rng.random() < 1.0 / (1.0 + math.exp(-compute_log_odds(evidence, TRUE)))
        poses.append(_pose(RIGHT if is_right else WRONG, evidence, k, MAPS[k % 3]))
    return poses


def test_poses_between_right_and_wrong_are_left_out():
    evidence = _evidence(np.random.default_rng(0))
    poses = [_pose(error, evidence) for error in (RIGHT, WRONG, BETWEEN, None)]
    assert [pose.is_right for pose in poses] == [True, False, False, False]
    assert decided(poses) == [poses[0], poses[1], poses[3]]


def test_weights_that_poses_were_drawn_with_are_found_again():
    poses = _drawn(6000)
    fitted = fit_evidence(poses, PRIOR, 0.1)
    there, here = (judged("all", _drawn(2000, seed=1), weights) for weights in (TRUE, fitted))
    assert np.corrcoef(there.log_odds, here.log_odds)[0, 1] > 0.99
    assert calibration_error(here.log_odds, here.is_right) < 0.06
    assert fitted.doubt == -0.5
    clearest = max(
        odds
        for odds, pose in zip(judged("", poses, fitted).log_odds, poses, strict=True)
        if pose.is_wrong
    )
    assert fitted.clear_log_odds > clearest


def test_an_out_of_map_image_lowers_the_bias_until_it_is_refused():
    poses = _drawn(1500)
    strongest = max(
        (pose.evidence for pose in poses),
        key=lambda evidence: compute_log_odds(evidence, TRUE),
    )
    fitted = fit_evidence([*poses, _pose(None, strongest)], PRIOR, 0.1)
    assert 1.0 / (1.0 + math.exp(-compute_log_odds(strongest, fitted))) == pytest.approx(
        0.35, abs=1e-6
    )
    assert fitted.bias < fit_evidence(poses, PRIOR, 0.1).bias - 1.0
    assert json.decode(json.encode(fitted), type=EvidenceWeights) == fitted


def test_every_family_is_judged_by_a_fit_without_it():
    poses = _drawn(3000)
    # the evidence of one family is inverted, which a fit without it cannot learn
    turned = [
        replace(pose, error_m=3.0 if pose.is_right else 0.01) if pose.mapping == MAPS[0] else pose
        for pose in poses
    ]
    held_out = {part.family: part for part in try_on_others(turned, PRIOR, 0.1)}
    assert set(held_out) == {"corridor", "lab", "kitchen"}
    assert calibration_error(held_out["corridor"].log_odds, held_out["corridor"].is_right) > 0.3
    assert sum(len(part.is_right) for part in held_out.values()) == len(decided(turned))


def test_few_poses_stay_with_the_prior_and_held_out_poses_set_its_strength():
    poses = _drawn(90)
    assert fit_evidence(poses, TRUE, 1e4).as_vector == pytest.approx(TRUE.as_vector, abs=0.01)
    assert best_strength(poses, TRUE) > best_strength(
        _drawn(3000), structs.replace(PRIOR, even_share=0.2, bias=-2.0)
    )


def test_calibration_error_is_the_mean_gap_of_reported_poses():
    log_odds = np.array(
        [math.log(9.0)] * 10 + [-3.0] * 50
    )  # ten answers of 0.9, of which six are right
    part = Judged("any", log_odds, np.array([True] * 6 + [False] * 4 + [True] * 50))
    assert calibration_error(part.log_odds, part.is_right) == pytest.approx(0.3)


def test_shared_errors_put_95_percent_inside():
    rng, before = np.random.default_rng(0), CorrelatedErrorWeights(2.0, 0.005, 0.1)
    evidence = _evidence(rng)

    def poses(true_rho: float, said_rho: float) -> list[TriedPose]:
        covariance_inflation = 1.0 + evidence.num_found * true_rho
        return [
            replace(
                _pose(RIGHT, evidence),
                square=float(covariance_inflation * rng.chisquare(6)),
                rho=said_rho,
            )
            for _ in range(4000)
        ]

    fitted = fit_shared_errors([*poses(0.03, 0.02), *poses(0.02, 0.005)], before)
    assert fitted.factor == pytest.approx(3.0, rel=0.15)
    assert fitted.least == pytest.approx(0.02, rel=0.15)
    assert fit_shared_errors(poses(0.001, 0.02), before) == before  # never smaller
    assert fit_shared_errors([_pose(WRONG, evidence)], before) == before


def test_wrong_poses_are_tried_as_well_and_not_stopped_before(
    tiny_recording: Path, monkeypatch: pytest.MonkeyPatch
):
    stops, localize = list[NodeStop](), Localizer.localize

    def noted(self: Localizer, *args: object, **named: object):
        stops.append(self.context.first.weights.stop)
        return localize(self, *args, **named)  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(Localizer, "localize", noted)
    recordings = {"demo/room": open_sequence(tiny_recording)}
    poses = ask_place(
        AskedPlace("demo/room", {"demo/room": 3}), recordings, Path(), "topoloc-net", 1
    )
    assert any(pose.is_right for pose in poses)
    assert set(stops) == {NodeStop()} != {load_fitted_weights("topoloc-net").stop}


def test_pairs_are_of_one_image_and_too_few_of_them_change_nothing():
    strong, weak = (
        Evidence(150, 90, 300, 900, 20, 0.8, 0.1, 0.3),
        Evidence(150, 60, 250, 900, 20, 0.7, 0.3, 0.05),
    )
    before = RivalWeights(0.3, 6.0, -3.0, 2.0)
    poses = [
        pose
        for k in range(MIN_HARD_PAIRS)
        for pose in (_pose(RIGHT, strong, k), _pose(WRONG, weak, k))
    ]
    differences, is_hard = pairs_of(poses, TRUE)
    assert len(differences) == MIN_HARD_PAIRS
    assert is_hard.all()
    assert num_mistaken(differences, before) == 0
    assert fit_rivals(poses[2:], TRUE, before) == (before, MIN_HARD_PAIRS - 1)
    fitted, num_hard = fit_rivals(poses, TRUE, before)
    assert num_hard == MIN_HARD_PAIRS
    assert fitted != before
    assert min(fitted.odds, fitted.even_share, -fitted.doubt) >= 0.0
    assert len(pairs_of([replace(pose, error_m=None) for pose in poses], TRUE)[0]) == 0


def test_the_command_writes_a_file_that_ships(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    kept, out = (tmp_path / "a.json", tmp_path / "b.json"), tmp_path / "sift.json"
    poses = _drawn(900)
    save_poses(poses[:450], kept[0])
    save_poses(poses[450:], kept[1])
    assert load_poses(kept[0]) == poses[:450]
    monkeypatch.setattr(
        sys, "argv", ["fit", "--kind", "sift", "--load", *map(str, kept), "--out", str(out)]
    )
    command.main()
    weights = read_weights(out)
    assert weights.kind == "sift"
    assert weights.is_calibrated
    prior = load_fitted_weights("surf").evidence
    assert weights.evidence == fit_evidence(poses, prior, best_strength(poses, prior))
    assert "900 poses tried" in weights.corpus
    assert "corridor, fitted without it" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("kind", "said"),
    [("orb", "no features of kind 'orb'"), ("sift", "right and wrong poses of two families")],
)
def test_impossible_fits_are_one_line(
    kind: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    save_poses([pose for pose in _drawn(50) if pose.is_wrong], tmp_path / "poses.json")
    monkeypatch.setattr(
        sys, "argv", ["fit", "--kind", kind, "--load", str(tmp_path / "poses.json")]
    )
    with pytest.raises(SystemExit, match=said):
        command.main()


def _on_walls(num: int, weights: FittedWeights, seed: int = 0) -> list[TriedPose]:
    """Draw poses of virtual views, each right with the probability of these weights."""
    rng, poses = np.random.default_rng(seed), []
    for k in range(num):
        evidence = replace(
            _evidence(rng),
            num_distinct=int(rng.integers(0, 60)),
            num_lesser_side=int(rng.integers(0, 40)),
        )
        is_right = rng.random() < 1.0 / (1.0 + math.exp(-weights.log_odds(evidence)))
        poses.append(_pose(RIGHT if is_right else WRONG, evidence, k))
    return poses


def test_weights_of_virtual_views_are_recovered_and_kept_with_few_poses():
    before = load_fitted_weights("surf")
    true = replace(
        before,
        walls=structs.replace(
            before.walls, spread=2.0, lesser_side=0.7, bias=before.walls.bias - 3.5
        ),
    )
    fitted, num = fit_walls(_on_walls(4000, true), before.walls)
    assert num == 4000
    told = _on_walls(500, true, seed=1)
    there, here = (
        np.array([weights.log_odds(pose.evidence) for pose in told])
        for weights in (true, replace(before, walls=fitted))
    )
    assert np.mean(np.abs(there - here)) < 0.4
    assert np.mean(np.abs(there - [before.log_odds(pose.evidence) for pose in told])) > 1.0
    assert fitted.doubt == before.walls.doubt
    assert fit_walls(_on_walls(MIN_POSES, true), before.walls) == (before.walls, 0)
