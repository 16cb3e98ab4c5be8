"""Fit the weights of `localization/verification.py`, and see what they do to places they were not fitted on.

    python benchmarks/acceptance.py [--shared ../shared]

Each place is asked about its own queries (as they are, dark, darker), about those of the other places, and about drawn
pictures; every pose that comes out is kept, however weak, and is right within 0.25 m (0.5 m in streets) and 5 degrees.
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
from topoloc.localization.verification import VerificationConfig
from topoloc.mapping.build import BuildConfig, build_map
from topoloc.mapping.nodes import NodeConfig
from topoloc.sequences.frame import StereoFrame
from topoloc.sequences.open import open_sequence

EVERYTHING = LocalizerConfig(verification=VerificationConfig(min_inliers=4, min_found=4, min_probability=0.0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, default=Path(os.environ.get("TOPOLOC_SHARED", "../shared")))
    data = parser.parse_args().shared / "data"
    places = [place for place in PLACES if "30 of 50" not in place.name]
    queries = {place.name: list(open_sequence(data / place.queries)) for place in places}
    rows, right, of_place = [], [], []
    for place in places:
        for row, is_right in poses(place, data, queries):
            rows.append(row)
            right.append(is_right)
            of_place.append(place.name)
    x, y, names = np.array(rows), np.array(right), np.array(of_place)
    print(f"{len(y)} poses, {np.count_nonzero(~y)} of them wrong")
    print("weights (found, inliers, inlier share, bias):", fit(x, y).round(2))
    for place in places:
        here = names == place.name
        accepted = x[here] @ fit(x[~here], y[~here]) > 0
        wrong, lost, num_right = np.sum(accepted & ~y[here]), np.sum(~accepted & y[here]), np.sum(y[here])
        print(f"fitted without {place.name}: accepts {wrong} of {np.sum(~y[here])} wrong, loses {lost} of {num_right} right")


def poses(place: Place, data: Path, queries: dict[str, list[StereoFrame]]) -> list[tuple[list[float], bool]]:
    """(logarithms as in `probability_of`, is it right?) of every pose that the place's map gives."""
    topomap = build_map(open_sequence(data / place.mapping), BuildConfig(nodes=NodeConfig(d_thresh=place.d_thresh)))
    localizer = Localizer(topomap, EVERYTHING)
    world_from_truth = read_rigid(data / place.map_from_truth) if place.map_from_truth else Rigid3.identity()
    max_metres = 0.25 if place.d_thresh else 0.5
    found = []
    for i, frame in enumerate(queries[place.name]):
        assert frame.world_from_cam is not None
        truth = world_from_truth @ frame.world_from_cam
        for image in (frame.image, darkened(frame.image, 0.6, i), darkened(frame.image, 1 / 0.6, i)):
            result = ask(localizer, frame, image)
            if isinstance(result, Localization):
                error = result.world_from_cam.inverse() @ truth
                found.append((features(result), bool(np.linalg.norm(error.translation) < max_metres and error.angle() < np.deg2rad(5.0))))
    camera = Camera.pinhole(640, 480, 525.0, 525.0, 319.5, 239.5)
    elsewhere = [ask(localizer, frame) for name, other in queries.items() if name != place.name for frame in other]
    elsewhere += [localizer.localize(image, camera) for image in drawn_pictures(100)]
    return found + [(features(result), False) for result in elsewhere if isinstance(result, Localization)]


def features(result: Localization) -> list[float]:
    e = result.evidence
    assert e is not None
    found_share, inlier_share = (e.num_found + 1) / (e.num_visible + 20), (e.num_inliers + 1) / (e.num_matches + 10)
    return [float(np.log(found_share)), float(np.log(e.num_inliers + 1)), float(np.log(inlier_share)), 1.0]


def fit(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Logistic regression, right and wrong weighing alike, lightly shrunk."""
    weights = np.where(y, 0.5 / y.mean(), 0.5 / (~y).mean())
    signs = 2 * y - 1

    def loss(b: np.ndarray) -> float:
        return float(np.sum(weights * np.logaddexp(0.0, -signs * (x @ b))) + 5e-4 * len(y) * np.sum(b[:-1] ** 2))

    return minimize(loss, np.zeros(x.shape[1])).x


if __name__ == "__main__":
    main()
