"""Test the scale by places on earth: noise, drift, outliers, and places that say nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float
from PIL import ExifTags, Image

from topoloc.apps.reconstruction.gnss import fit_places, read_exif_places
from topoloc.apps.reconstruction.photos import PosedView, Reconstruction
from topoloc.geometry.geodesy import GeoPoint
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.open import open_sequence

UNIT, ORIGIN = 0.4, GeoPoint(50.1, 8.6, 120.0)
_TURN = Rigid3.exp(np.array([1.0, 2.0, 3.0, 0.3, -0.5, 0.8]))


def _walk(num: int = 60, length: float = 60.0) -> Float[np.ndarray, "n 3"]:
    """Return positions of a walk with a bend, metres in east-north-up."""
    along = np.linspace(0.0, length, num)
    across = 0.1 * length * np.sin(np.linspace(0.0, np.pi, num))
    return np.column_stack([along, across, 1.5 + 0.1 * np.sin(along)])


def _places(enu: Float[np.ndarray, "n 3"]) -> list[GeoPoint]:
    return [GeoPoint.from_ecef(point) for point in ORIGIN.ecef_from_enu().apply(enu)]


def _positions(enu: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return _TURN.apply(enu / UNIT)


def test_white_noise_and_drift_stay_within_their_sigma():
    walk, rng = _walk(), np.random.default_rng(0)
    white, drifting = list[float](), list[bool]()
    for _ in range(100):
        noise = rng.normal(size=walk.shape)
        fit = fit_places(_positions(walk), _places(walk + noise))
        assert fit is not None
        white.append(abs(fit[0] / UNIT - 1.0))
        drift = rng.normal(size=3)
        drift *= 3.0 / np.linalg.norm(drift)
        share = np.linspace(0.0, 1.0, len(walk))[:, None]
        fit = fit_places(_positions(walk), _places(walk + noise + share * drift))
        assert fit is not None
        drifting.append(abs(np.log(fit[0] / UNIT)) < 2.0 * fit[1])
    assert np.quantile(white, 0.95) < 0.03
    assert np.mean(drifting) >= 0.93


def test_a_third_of_the_places_off_by_tens_of_metres():
    walk, rng = _walk(), np.random.default_rng(1)
    wrong = walk + rng.normal(size=walk.shape)
    wrong[10:30] += [40.0, -25.0, 10.0]
    fit = fit_places(_positions(walk), _places(wrong))
    assert fit is not None
    assert fit[0] == pytest.approx(UNIT, rel=0.05)


@pytest.mark.parametrize("length", [0.0, 3.0])
def test_a_room_or_one_repeated_fix_says_nothing(length: float):
    noise = np.random.default_rng(2).normal(size=(60, 3)) * (length > 0.0)
    assert fit_places(_positions(_walk()), _places(_walk(length=length) + noise)) is None
    assert fit_places(_positions(_walk())[:5], _places(_walk())[:5]) is None


def test_places_are_read_from_photos(tmp_path: Path):
    walk = _walk(9)
    for number, place in enumerate(_places(walk)):
        exif = Image.Exif()
        degrees = [(abs(value), 0.0, 0.0) for value in (place.lat, place.lon)]
        gps = {
            ExifTags.GPS.GPSLatitudeRef: "N",
            ExifTags.GPS.GPSLatitude: degrees[0],
            ExifTags.GPS.GPSLongitudeRef: "E",
            ExifTags.GPS.GPSLongitude: degrees[1],
            ExifTags.GPS.GPSAltitude: place.h,
        }
        for tag, value in gps.items() if number else ():  # the first has none
            exif.get_ifd(ExifTags.IFD.GPSInfo)[tag] = value
        Image.new("L", (32, 32), number).save(tmp_path / f"{number}.jpg", exif=exif)
    poses: list[Rigid3 | None] = [
        Rigid3(np.eye(3), position) if number != 5 else None
        for number, position in enumerate(_positions(walk))
    ]
    view = PosedView(open_sequence(tmp_path), list(range(9)), poses)
    positions, places = read_exif_places(Reconstruction([view], []))
    assert len(positions) == len(places) == 7
    assert places[0].lat == pytest.approx(_places(walk)[1].lat, abs=1e-7)
    assert places[0].h == pytest.approx(_places(walk)[1].h, abs=1e-2)
