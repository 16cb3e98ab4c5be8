"""Fit the weights of a feature type, and test them on places outside of the fit.

    python -m topoloc_paper.fit --kind KIND [--shared ../shared] [--rendered FOLDER] [--step N]
    [--families NAME ...] [--walls]
                                [--save POSES | --load POSES ...] [--out FILE]

Each place of `corpus.py` is mapped with this feature type. Queries are its own images (bright and
darkened), images of other places and drawn images. Every tested pose is kept, not only the reported
one. A pose is right within 0.25 m (5 % of the distance, if that is less) and 2 degrees, and wrong
beyond 0.5 m or 10 degrees. Poses in between are left out. Virtual views are queried in places that
were mapped in one direction and are queried in reverse.

`--walls` queries these places alone and fits the weights of virtual views. The other weights stay.
`--step N` queries every N-th image, `--families` only the maps of these places. `--by-recording`
tests the poses of each recording with weights fitted to all others, instead of each family.
`--save` stores the poses after each place, and `--load` fits to stored poses. FILE has the format
of `localization/weights/KIND.json`.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from topoloc.errors import TopolocError
from topoloc.features.feature_types import find_feature_type
from topoloc.localization.fitted_weights import (
    FALLBACK_TYPE,
    FittedWeights,
    compute_log_odds,
    load_fitted_weights,
)
from topoloc_paper.fit.corpus import FAMILIES, PLACES, AskedPlace, family_of, open_recordings
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
from topoloc_paper.fit.walls import fit_walls, told_by_walls


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m topoloc_paper.fit",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--kind", required=True)
    parser.add_argument(
        "--shared", type=Path, default=Path(os.environ.get("TOPOLOC_SHARED", "../shared"))
    )
    parser.add_argument("--rendered", type=Path)
    parser.add_argument("--step", type=int, default=1)
    parser.add_argument("--families", nargs="+", choices=sorted(set(FAMILIES.values()) - {"drawn"}))
    parser.add_argument("--walls", action="store_true")
    parser.add_argument("--by-recording", action="store_true")
    parser.add_argument("--save", type=Path)
    parser.add_argument("--load", type=Path, nargs="+")
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    try:
        find_feature_type(asked.kind)
    except TopolocError as error:
        raise SystemExit(f"error: {error}") from error
    if asked.load:
        poses = [pose for path in asked.load for pose in load_poses(path)]
    else:
        places = [
            place
            for place in PLACES
            if asked.families is None or family_of(place.mapping) in asked.families
        ]
        places = [place for place in places if place.asks_walls] if asked.walls else places
        poses = ask_places(
            asked.kind,
            asked.shared.resolve() / "data",
            asked.rendered,
            asked.step,
            asked.save,
            places,
        )
    if asked.walls:
        _write(fit_walls_alone(asked.kind, poses), asked.out)
        return
    wrong_of = {
        pose.queries if asked.by_recording else family_of(pose.mapping)
        for pose in decided(poses)
        if pose.is_wrong
    }
    right_of = {
        pose.queries if asked.by_recording else family_of(pose.mapping)
        for pose in decided(poses)
        if pose.is_right
    }
    if len(wrong_of) < 2 or len(right_of) < 2:
        parts = "recordings" if asked.by_recording else "families of places"
        raise SystemExit(f"error: right and wrong poses of two {parts} are needed")
    _write(fit(asked.kind, poses, asked.step, asked.by_recording), asked.out)


def _write(weights: FittedWeights, path: Path | None) -> None:
    if path:
        path.write_text(json.dumps(weights.to_json(), indent=2) + "\n", encoding="utf-8")


def ask_places(
    kind: str,
    data: Path,
    rendered: Path | None,
    step: int,
    kept: Path | None,
    places: Sequence[AskedPlace] = PLACES,
) -> list[TriedPose]:
    """Every pose that these places lead to; written to `kept` after each place."""
    recordings = open_recordings(data, rendered)
    poses: list[TriedPose] = []
    for place in places:
        here = ask_place(place, recordings, data, kind, step)
        poses += here
        print(
            f"{place.mapping}: {len(here)} poses of {len({pose.picture for pose in here})}"
            " pictures",
            flush=True,
        )
        if kept:
            save_poses(poses, kept)
    return poses


def fit(kind: str, poses: list[TriedPose], step: int, by_recording: bool) -> FittedWeights:
    """Fitted weights of this kind, with a report of how they do beside those in use;
    `by_recording`: see `try_on_others`."""
    before, prior = load_fitted_weights(kind), load_fitted_weights(FALLBACK_TYPE).evidence
    walls, num_walls = fit_walls(poses, before.walls)
    poses = [pose for pose in poses if pose.evidence.num_distinct is None]
    strength = best_strength(poses, prior, by_recording)
    evidence, held_out = (
        fit_evidence(poses, prior, strength),
        try_on_others(poses, prior, strength, by_recording),
    )
    log_odds, is_right = (
        np.concatenate([getattr(part, name) for part in held_out])
        for name in ("log_odds", "is_right")
    )
    rivals, num_hard = fit_rivals(poses, evidence, before.rivals)
    fitted = FittedWeights(
        kind,
        corpus_of(poses, strength, num_hard, num_walls, by_recording),
        datetime.date.today().isoformat(),
        f"python -m topoloc_paper.fit --kind {kind} --rendered FOLDER --step"
        f" {step}{' --by-recording' if by_recording else ''} --out FILE",
        round(calibration_error(log_odds, is_right), 4),
        evidence,
        rivals,
        walls,
        fit_shared_errors(poses, load_fitted_weights(FALLBACK_TYPE).shared_errors),
        before.confirmation,
        before.stop,
    )
    report(poses, before, fitted, held_out)
    print(f"{walls}, fitted to {num_walls} poses ({before.walls})")
    return fitted


def fit_walls_alone(kind: str, poses: list[TriedPose]) -> FittedWeights:
    """Return the current weights with newly fitted weights of virtual views.

    The feature type is the one that describes the virtual views of `kind`.
    """
    before = load_fitted_weights(find_feature_type(kind).virtual_view_type)
    walls, num = fit_walls(poses, before.walls)
    told = told_by_walls(poses)
    for name, weights in (("in use", before.walls), ("fitted", walls)):
        log_odds = np.array([compute_log_odds(pose.evidence, weights) for pose in told])
        part = Judged("walls", log_odds, np.array([pose.is_right for pose in told], dtype=bool))
        clearest = max(log_odds[~part.is_right], default=-99.0)
        print(
            f"{name}: {weights}\n  {verdict(part)}; log odds of the clearest wrong pose"
            f" {clearest:.1f}"
        )
    places = ", ".join(dict.fromkeys(pose.queries for pose in told))
    said = f"walls fitted to {num} poses of {places} (--walls)"
    corpus = (
        re.sub(r"[Ww]alls:? (taken over|fitted to [^;]*)", said, before.corpus)
        if num
        else before.corpus
    )
    return replace(before, walls=walls, corpus=corpus, date=datetime.date.today().isoformat())


def corpus_of(
    poses: list[TriedPose], strength: float, num_hard: int, num_walls: int, by_recording: bool
) -> str:
    """Return one sentence about the poses used for the fit."""
    num_right, told = sum(pose.is_right for pose in poses), decided(poses)
    places = ", ".join(dict.fromkeys(pose.mapping for pose in poses))
    elsewhere = sum(pose.error_m is None for pose in poses)
    rivals = (
        f"fitted to {num_hard} hard pairs"
        if num_hard >= MIN_HARD_PAIRS
        else f"taken over, {num_hard} hard pairs being too few"
    )
    return (
        f"{len(told)} poses tried, {num_right} of them right, {elsewhere} of pictures from"
        f" elsewhere, of maps of {places}; drawn to the weights of {FALLBACK_TYPE} with the"
        f" strength {strength:g}; rivals {rivals}; walls"
        f" {f'fitted to {num_walls} poses' if num_walls else 'taken over'}; taken over: the weights"
        " of the doubt; shared_errors where fewer than 200 right poses tell. Calibration error: of"
        f" poses that would be answered, each {'recording' if by_recording else 'family of places'}"
        " judged by a fit without it"
    )


def report(
    poses: list[TriedPose], before: FittedWeights, fitted: FittedWeights, held_out: list[Judged]
) -> None:
    num_right, told = sum(pose.is_right for pose in poses), decided(poses)
    print(
        f"{len(told)} poses, {num_right} of them right; {len(poses) - len(told)} more are neither"
        " right nor wrong"
    )
    for name, weights in (("in use", before), ("fitted", fitted)):
        all_poses = judged("all", told, weights.evidence)
        elsewhere = judged(
            "elsewhere", [pose for pose in told if pose.error_m is None], weights.evidence
        )
        clearest, most = (
            max(part.log_odds[~part.is_right], default=-99.0) for part in (all_poses, elsewhere)
        )
        print(f"{name}: {weights.evidence}")
        print(f"  {verdict(all_poses)}; log odds of the clearest wrong pose {clearest:.1f},")
        print(
            f"  probability of the most probable of {len(elsewhere.is_right)} from elsewhere"
            f" {1 / (1 + np.exp(-most)):.2f}"
        )
    for part in held_out:
        in_use = judged(
            part.family,
            [pose for pose in told if part.family in (family_of(pose.mapping), pose.queries)],
            before.evidence,
        )
        print(f"{part.family}, fitted without it: {verdict(part)}\n  in use: {verdict(in_use)}")
    differences, is_hard = pairs_of(poses, fitted.evidence)
    was, now = (
        num_mistaken(differences[is_hard], rivals) for rivals in (before.rivals, fitted.rivals)
    )
    print(f"rivals: {fitted.rivals}, {now} of {np.sum(is_hard)} hard pairs mistaken ({was})")
    print(f"{fitted.shared_errors} ({before.shared_errors})")
    print(f"calibration error, each part judged by a fit without it: {fitted.calibration_error}")


def verdict(part: Judged) -> str:
    wrong, lost = (
        np.sum((part.log_odds > 0) & ~part.is_right),
        np.sum((part.log_odds <= 0) & part.is_right),
    )
    error = calibration_error(part.log_odds, part.is_right)
    return (
        f"accepts {wrong} of {np.sum(~part.is_right)} wrong, loses {lost} of"
        f" {np.sum(part.is_right)} right, calibration error {error:.3f}"
    )


if __name__ == "__main__":
    main()
