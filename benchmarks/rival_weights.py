"""Fit the weights of `localization/belief.py` anew: which of two poses of one picture, far from each other, is the right one?

    python benchmarks/acceptance.py --rendered FOLDER --save POSES
    python benchmarks/rival_weights.py POSES

Of each picture's poses within 0.5 m and 10 degrees the strongest is paired with every wrong pose that could be taken for it. A pair is
hard where the wrong pose comes near to being believed on its own. Weights are compared by how many pairs they get wrong, and how many
stay, either way, within the lead that an answer needs (`MIN_LEAD`), so that "ambiguous" is said. The slope is what the leads over hard
pairs must be multiplied by to be logarithms of odds. The fit is to hard pairs; they are few, and those in use were chosen by hand.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from acceptance import TriedPose, load_poses
from topoloc.localization.belief import MIN_LEAD
from topoloc.localization.evidence import log_odds_of, score_features
from topoloc.localization.fitted_weights import weights_of

WEIGHTS = weights_of("surf")
IN_USE = WEIGHTS.rivals
COULD_BE_TAKEN = -1.5
"""Logarithm of the odds of a wrong pose that makes a pair; one that is less than `NEAR` behind the right one makes a pair, too."""
NEAR = 2.0
HARD = -0.5
"""Logarithm of the odds of the wrong pose of a hard pair."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("poses", type=Path)
    differences, is_hard, of_picture = pairs_of(load_poses(parser.parse_args().poses))
    print(f"{len(differences)} pairs, {is_hard.sum()} of them hard")
    if not is_hard.any():
        raise SystemExit("there is no hard pair to fit to")
    in_use = np.array([IN_USE.odds, IN_USE.even_share, IN_USE.doubt])
    odds, even, doubt = np.diag(in_use)
    candidates = {"fitted": fit(differences[is_hard]), "in use": in_use, "without the doubt": odds + even, "without the odds": even + doubt}
    candidates |= {"without the even share": odds + doubt, "the odds alone": np.array([1.0, 0.0, 0.0])}
    beyond = f"> {MIN_LEAD:g}"
    heading = f"hard: wrong / by {beyond}, right by {beyond}"
    print(f"{'':24}{'odds':>6}{'even':>6}{'doubt':>7}{'slope':>7}   {heading:40}all")
    for name, weights in candidates.items():
        lead = differences @ weights
        hard, every = outcome(lead[is_hard]), outcome(lead)
        print(f"{name:24}{weights[0]:6.2f}{weights[1]:6.2f}{weights[2]:7.2f}{slope(lead[is_hard]):7.2f}   {hard:40}{every}")
    odds, even, doubt = deviation(differences[is_hard], of_picture[is_hard])
    print(f"standard deviation of the fitted weights: {odds:.2f}, {even:.2f}, {doubt:.2f}")


def pairs_of(poses: list[TriedPose]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """By how much the right pose of each pair leads in the log odds, the even share and the doubt (logarithms), [n, 3]; is it hard? And
    the number of its picture."""
    of_picture: dict[tuple[str, str, int, str], list[TriedPose]] = {}
    for pose in poses:
        if pose.error_m is not None:
            of_picture.setdefault(pose.picture, []).append(pose)
    differences, is_hard, numbers = [], [], []
    for number, tried in enumerate(of_picture.values()):
        right = [terms(pose) for pose in tried if not pose.is_wrong]
        if not right:
            continue
        best = max(right, key=lambda those: those[0] + 3.0 * those[1])
        for wrong in (terms(pose) for pose in tried if pose.is_wrong):
            if wrong[0] > min(COULD_BE_TAKEN, best[0] - NEAR):
                differences.append(best - wrong)
                is_hard.append(wrong[0] > HARD)
                numbers.append(number)
    return np.array(differences).reshape(-1, 3), np.array(is_hard, dtype=bool), np.array(numbers, dtype=int)


def terms(pose: TriedPose) -> np.ndarray:
    """What is weighed between two poses, in the order of the weights."""
    features = score_features(pose.evidence)
    return np.array([log_odds_of(pose.evidence, WEIGHTS), features[0], features[-1]])


def fit(differences: np.ndarray) -> np.ndarray:
    """Logistic regression without a bias, lightly shrunk; neither odds nor even share may count against a pose, nor doubt for it."""

    def loss(weights: np.ndarray) -> float:
        return float(np.sum(np.logaddexp(0.0, -differences @ weights)) + 5e-4 * len(differences) * np.sum(weights**2))

    return minimize(loss, np.array([0.1, 0.1, -0.1]), bounds=[(0.0, None), (0.0, None), (None, 0.0)], method="L-BFGS-B").x


def deviation(differences: np.ndarray, of_picture: np.ndarray, num_rounds: int = 50) -> np.ndarray:
    """Standard deviation of the fitted weights, from pictures drawn anew: pairs of one picture share a pose."""
    rng, pictures = np.random.default_rng(0), np.unique(of_picture)
    draws = rng.choice(pictures, (num_rounds, len(pictures)))
    return np.std([fit(np.concatenate([differences[of_picture == picture] for picture in draw])) for draw in draws], axis=0)


def slope(lead: np.ndarray) -> float:
    return float(minimize(lambda s: np.sum(np.logaddexp(0.0, -s[0] * lead)), [1.0], bounds=[(0.0, 20.0)], method="L-BFGS-B").x[0])


def outcome(lead: np.ndarray) -> str:
    wrong, badly, clearly = np.sum(lead < 0), np.sum(lead < -MIN_LEAD), np.sum(lead > MIN_LEAD)
    return f"{wrong} / {badly}, {clearly} of {len(lead)}"


if __name__ == "__main__":
    main()
