"""Test the metric scale of a model, given as a number or by measured distances."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from topoloc.apps.formats.colmap import estimate_metric_scale
from topoloc.errors import TrajectoryError
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.recording import Recording

PLACES = [(0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (2.0, 1.0, 0.0), (0.0, 0.0, 4.0)]
NAMES = ["a/IMG_1.jpg", "a/IMG_2.jpg", "b/IMG_2.jpg", "b/IMG_3.jpg", "b/IMG_4.jpg"]
POSES = [*(Rigid3(np.eye(3), np.array(place)) for place in PLACES), None]
MODEL = Recording("model", Path("model"), NAMES, list(range(5)), POSES, None, has_scale=False)


@pytest.mark.parametrize(
    ("texts", "scale"),
    [
        (("0.42",), 0.42),
        (("IMG_1,IMG_3=2m",), 0.5),
        (("a/IMG_1.jpg,a/IMG_2.jpg=1.0",), 0.5),
        (("IMG_1.jpg , b/IMG_2.jpg = 1.118 m",), 0.5),
        (("a/IMG_2.jpg,a/IMG_1.jpg=1.02m", "IMG_1,IMG_3=2.0m"), (2 * 1.02 + 4 * 2.0) / 20.0),
    ],
)
def test_a_unit_in_metres(texts: tuple[str, ...], scale: float):
    assert estimate_metric_scale(texts, MODEL) == pytest.approx(scale, rel=1e-3)


@pytest.mark.parametrize(
    ("texts", "said"),
    [
        (
            ("a/IMG_1.jpg,a/IMG_2.jpg=1m", "IMG_1,IMG_3=2.2m"),
            "do not agree: a/IMG_1.jpg,a/IMG_2.jpg=1m makes a unit 0.5 m",
        ),
        (("IMG_1,IMG_9=2m",), "0 images are named IMG_9; take one of these: a/IMG_1.jpg, "),
        (("IMG_1,IMG_2=2m",), "2 images are named IMG_2; give its folder, too: a/IMG_2.jpg, "),
        (("IMG_1,IMG_4=2m",), "IMG_4 has no pose"),
        (("IMG_1,IMG_1=2m",), "the same position"),
        (("IMG_1,IMG_3=-2m",), "must be above 0 m"),
        (("IMG_1,IMG_3=1e999m",), "must be above 0 m"),
        (("IMG_1=2m",), "no distance between two images"),
        (("0.5", "0.5"), "no distance between two images"),
        (("0",), "a scale is a positive number"),
        (("nan",), "a scale is a positive number"),
        (("big",), "a scale is a positive number"),
    ],
)
def test_invalid_scales_are_refused(texts: tuple[str, ...], said: str):
    with pytest.raises(TrajectoryError) as error:
        estimate_metric_scale(texts, MODEL)
    assert said in str(error.value)
