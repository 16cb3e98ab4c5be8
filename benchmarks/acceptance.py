"""Fit the weights of `localization/verification.py`, and see what they do to places they were not fitted on.

    python benchmarks/acceptance.py [--shared ../shared] [--rendered FOLDER]

Each place is asked about its own queries (as they are, dark, darker), about those of the other places, and about drawn
pictures; every pose that comes out is kept, however weak, and is right within 0.25 m (5 % of the distance, where that is
less) and 2 degrees. FOLDER may hold `corridor_map`, `corridor_day`, `corridor_evening` and `corridor_night` (`topoloc
simulate`): a place with much that is there twice. The weight of the doubt is not fitted, see there.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from real_recordings import PLACES, Place, ask, darkened, drawn_pictures, read_rigid
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.result import Localization
from topoloc.localization.verification import VerificationConfig, score_features, tolerated_translation
from topoloc.mapping.build import BuildConfig, build_map
from topoloc.mapping.nodes import NodeConfig
from topoloc.sequences.frame import StereoFrame
from topoloc.sequences.open import open_sequence

BEYOND = Place("kitchen, beyond the map", "seven_scenes/kitchen@0:120", "seven_scenes/kitchen@120::2", 0.5)
LIGHTS = ("day", "evening", "night")
DOUBT_WEIGHT = VerificationConfig().doubt_weight
EVERYTHING = LocalizerConfig(verification=VerificationConfig(min_inliers=4, min_found=4, min_probability=0.0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, default=Path(os.environ.get("TOPOLOC_SHARED", "../shared")))
    parser.add_argument("--rendered", type=Path)
    arguments = parser.parse_args()
    data = arguments.shared.resolve() / "data"
    places = [place for place in PLACES if "30 of 50" not in place.name] + [BEYOND]
    if arguments.rendered:
        folder = arguments.rendered.resolve()
        places += [Place(f"corridor, {light}", f"{folder}/corridor_map", f"{folder}/corridor_{light}") for light in LIGHTS]
    queries = {place.name: list(open_sequence(data / place.queries)) for place in places}
    rows, right, of_place = [], [], []
    for place in places:
        for row, is_right in poses(place, data, queries):
            rows.append(row)
            right.append(is_right)
            of_place.append(place.name)
    x, y = np.array(rows), np.array(right)
    print(f"{len(y)} poses, {np.count_nonzero(~y)} of them wrong")
    print("weights (even share, chance, inliers, inlier share, spread; bias):", fit(x, y).round(2))
    for family in sorted({family_of(name) for name in of_place}):
        here = np.array([family_of(name) == family for name in of_place])
        odds = log_odds(x[here], fit(x[~here], y[~here]))
        accepted, probability = odds > 0, 1.0 / (1.0 + np.exp(-odds))
        wrong, lost, num_right = np.sum(accepted & ~y[here]), np.sum(~accepted & y[here]), np.sum(y[here])
        print(
            f"fitted without {family}: accepts {wrong} of {np.sum(~y[here])} wrong, loses {lost} of {num_right} right;"
            f" calibration error {calibration_error(probability, y[here]):.3f}"
        )


def poses(place: Place, data: Path, queries: dict[str, list[StereoFrame]]) -> list[tuple[list[float], bool]]:
    """(logarithms as in `probability_of`, is it right?) of every pose that the place's map gives."""
    topomap = build_map(open_sequence(data / place.mapping), BuildConfig(nodes=NodeConfig(d_thresh=place.d_thresh)))
    localizer = Localizer(topomap, EVERYTHING)
    world_from_truth = read_rigid(data / place.map_from_truth) if place.map_from_truth else Rigid3.identity()
    found = []
    for i, frame in enumerate(queries[place.name]):
        assert frame.world_from_cam is not None
        truth = world_from_truth @ frame.world_from_cam
        for image in (frame.image, darkened(frame.image, 0.6, i), darkened(frame.image, 1 / 0.6, i)):
            assert frame.camera is not None
            result, seen = localizer.localize_near(image, frame.camera, None)
            if isinstance(result, Localization) and seen is not None:
                error = result.world_from_cam.inverse() @ truth
                depth = float(np.median(result.world_from_cam.inverse().apply(seen.points_world)[:, 2]))
                is_near = np.linalg.norm(error.translation) < tolerated_translation(depth, VerificationConfig())
                found.append((features(result), bool(is_near and error.angle() < np.deg2rad(2.0))))
    camera = Camera.pinhole(640, 480, 525.0, 525.0, 319.5, 239.5)
    elsewhere = [ask(localizer, frame) for name, other in queries.items() if family_of(name) != family_of(place.name) for frame in other]
    elsewhere += [localizer.localize(image, camera) for image in drawn_pictures(100)]
    return found + [(features(result), False) for result in elsewhere if isinstance(result, Localization)]


def family_of(name: str) -> str:
    """Maps and queries of one place go together."""
    return name.split(",")[0]


def features(result: Localization) -> list[float]:
    """What the regression weighs; the doubt last but one."""
    assert result.evidence is not None
    return [*score_features(result.evidence), 1.0]


def log_odds(x: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """`weights` are those of all but the doubt, whose weight is given."""
    return np.delete(x, -2, axis=1) @ weights + DOUBT_WEIGHT * x[:, -2]


def fit(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Logistic regression, lightly shrunk."""
    signs = 2 * y - 1

    def loss(weights: np.ndarray) -> float:
        return float(np.sum(np.logaddexp(0.0, -signs * log_odds(x, weights))) + 5e-4 * len(y) * np.sum(weights[:-1] ** 2))

    return minimize(loss, np.zeros(x.shape[1] - 1)).x


def calibration_error(probability: np.ndarray, y: np.ndarray, num_bins: int = 10) -> float:
    """Expected calibration error: the mean distance of the probability told from the share that is right."""
    bins = np.minimum((probability * num_bins).astype(int), num_bins - 1)
    errors = [abs(probability[bins == k].mean() - y[bins == k].mean()) * np.mean(bins == k) for k in range(num_bins) if np.any(bins == k)]
    return float(sum(errors))


if __name__ == "__main__":
    main()
