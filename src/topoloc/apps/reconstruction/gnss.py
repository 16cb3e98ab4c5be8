"""Find the metres in a unit of a reconstruction by the places on earth of its images, such as those
that a phone writes into EXIF.

A similarity is fitted robustly. Its standard deviation has two parts: the residuals, which count
less where successive ones are alike, and a drift along the walk, which no residual shows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from topoloc import GeoPoint, Rigid3, StereoSequence, TrajectoryError
from topoloc.apps.core_names import SequenceView, align_similarity, exif_place
from topoloc.apps.reconstruction.photos import Reconstruction

_MIN_PLACES = 8
_DRIFT_M = 1.5  # standard deviation of the change of GNSS errors from one end to the other
_MAX_SIGMA = 0.3  # relative: above it places say nothing about the scale
_NUM_SAMPLES, _NUM_ROUNDS, _GATE = 300, 10, 4.0
_MEDIAN_NORM = 1.538  # of a 3-D Gaussian, in standard deviations of one axis
_MIN_SIGMA_M = 0.01


def read_exif_places(
    found: Reconstruction,
) -> tuple[Float[np.ndarray, "n 3"], list[GeoPoint]]:
    """Return positions of cameras (units) and their places by EXIF, of images that have both."""
    positions, places = list[np.ndarray](), list[GeoPoint]()
    for sequence in found.sequences:
        files = _list_files(sequence)
        for pose, path in zip(sequence.poses, files, strict=True):
            if pose is not None and path is not None and (place := exif_place(path)) is not None:
                positions.append(pose.translation)
                places.append(place)
    return np.reshape(positions, (-1, 3)), places


def _list_files(sequence: StereoSequence) -> list[Path | None]:
    """Return the image file of each frame, None if it has none."""
    rows = list(range(len(sequence)))
    while isinstance(sequence, SequenceView):
        rows, sequence = [sequence.indices[row] for row in rows], sequence.base
    paths_of: Callable[[int], list[Path]] | None = getattr(sequence, "paths_of", None)
    return [None if paths_of is None else paths_of(row)[0] for row in rows]


def fit_places(
    positions: Float[np.ndarray, "n 3"], places: Sequence[GeoPoint]
) -> tuple[float, float] | None:
    """Return the metres in a unit of the positions, and its relative standard deviation. None if
    the places do not determine it."""
    if len(places) < _MIN_PLACES:
        return None
    enu_from_ecef = places[0].ecef_from_enu().inverse()
    enu = np.array([enu_from_ecef.apply(place.ecef()) for place in places])
    try:
        scale, chosen, sigma = _fit_robustly(positions, enu)
    except TrajectoryError:  # on one line, or all at one place
        return None
    if not scale > 0.0 or 2 * np.count_nonzero(chosen) < len(chosen):
        return None
    kept = positions[chosen]
    spread = scale * math.sqrt(float(np.sum((kept - kept.mean(axis=0)) ** 2)))
    length = spread * math.sqrt(12.0 / len(kept))  # of a straight walk of this spread
    relative = math.hypot(sigma / spread, _DRIFT_M / length)
    return (scale, relative) if relative < _MAX_SIGMA else None


def _fit_robustly(
    positions: Float[np.ndarray, "n 3"], enu: Float[np.ndarray, "n 3"]
) -> tuple[float, np.ndarray, float]:
    """Return the scale, which places agree, and the standard deviation (metres) of one coordinate,
    as large as if errors were independent. Least median of squares, then least squares of those
    that agree. Raises TrajectoryError."""

    def errors(fit: tuple[float, Rigid3]) -> Float[np.ndarray, "n 3"]:
        return fit[1].apply(fit[0] * positions) - enu

    fit, sigma = align_similarity(enu, positions), math.inf
    rng = np.random.default_rng(0)
    for _ in range(_NUM_SAMPLES):
        rows = rng.choice(len(enu), 4, replace=False)
        try:
            sample = align_similarity(enu[rows], positions[rows])
        except TrajectoryError:
            continue
        median = float(np.median(np.linalg.norm(errors(sample), axis=1)))
        if median / _MEDIAN_NORM < sigma:
            fit, sigma = sample, median / _MEDIAN_NORM
    chosen, left = np.ones(len(enu), bool), np.zeros((0, 3))
    for _ in range(_NUM_ROUNDS):
        sigma = max(sigma, _MIN_SIGMA_M)
        chosen = np.linalg.norm(errors(fit), axis=1) < _GATE * math.sqrt(3.0) * sigma
        fit = align_similarity(enu[chosen], positions[chosen])
        left = errors(fit)[chosen]
        sigma = math.sqrt(float(np.sum(left**2)) / max(3 * len(left) - 7, 1))
    alike = float(np.sum(left[1:] * left[:-1]) / max(float(np.sum(left**2)), 1e-12))
    alike = min(max(alike, 0.0), 0.95)  # correlation of successive errors
    return fit[0], chosen, max(sigma, _MIN_SIGMA_M) * math.sqrt((1.0 + alike) / (1.0 - alike))
