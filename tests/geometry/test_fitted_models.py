"""Compare every camera model of COLMAP with pycolmap, which runs in a process of its own: it does
not follow OpenCV in one."""

from __future__ import annotations

import json
import subprocess
import sys
from functools import cache
from importlib.util import find_spec

import numpy as np
import pytest

from topoloc.errors import CalibrationError
from topoloc.geometry.camera import MODELS, Camera

SIZE = 640, 480
CENTRE = [320.0, 241.0]
CASES = [
    ("SIMPLE_PINHOLE", [400.0, *CENTRE]),
    ("PINHOLE", [400.0, 410.0, *CENTRE]),
    ("SIMPLE_RADIAL", [400.0, *CENTRE, -0.1]),
    ("RADIAL", [400.0, *CENTRE, -0.1, 0.02]),
    ("OPENCV", [400.0, 410.0, *CENTRE, -0.1, 0.02, 0.001, -0.002]),
    ("FULL_OPENCV", [400.0, 410.0, *CENTRE, -0.1, 0.02, 0.001, -0.002, 0.01, 0.02, 0.01, 0.001]),
    ("OPENCV_FISHEYE", [300.0, 310.0, *CENTRE, 0.02, -0.01, 0.003, -0.001]),
    ("SIMPLE_FISHEYE", [300.0, *CENTRE]),
    ("FISHEYE", [300.0, 310.0, *CENTRE]),
    ("SIMPLE_RADIAL_FISHEYE", [300.0, *CENTRE, 0.02]),
    ("RADIAL_FISHEYE", [300.0, *CENTRE, 0.02, -0.01]),
    ("FOV", [400.0, 410.0, *CENTRE, 0.9]),
    ("FOV", [500.0, 500.0, *CENTRE, 0.0]),
    ("SIMPLE_DIVISION", [400.0, *CENTRE, -0.2]),
    ("DIVISION", [500.0, 510.0, *CENTRE, 0.05]),
    ("EUCM", [300.0, 310.0, *CENTRE, 0.6, 1.1]),
    (
        "THIN_PRISM_FISHEYE",
        [400.0, 410.0, *CENTRE, 0.05, 0.01, 5e-5, -3e-5, 0.001, -0.001, 4e-5, 2e-5],
    ),
    (
        "RAD_TAN_THIN_PRISM_FISHEYE",
        [350.0, 360.0, *CENTRE, -0.02, 0.06, -0.04, 0.01, 0.0, 0.0, *[1e-5] * 6],
    ),
]
PIXELS = np.stack(np.meshgrid(np.linspace(1, 639, 23), np.linspace(1, 479, 17)), -1).reshape(-1, 2)
SCRIPT = """
import json, sys, numpy, pycolmap
found = []
for model, params, pixels in json.load(sys.stdin):
    camera = pycolmap.Camera(model=model, width=640, height=480, params=params)
    points = numpy.array(camera.cam_from_img(numpy.array(pixels)))
    found.append([points.tolist(), str(int(camera.model))])
print(json.dumps([found, [m for m in pycolmap.CameraModelId.__members__ if m != "INVALID"]]))
"""


@cache
def theirs() -> tuple[list[np.ndarray], list[str]]:
    """Return pycolmap's points on the plane z = 1 of `PIXELS` in each case, and its models."""
    if find_spec("pycolmap") is None:
        pytest.skip("the extra colmap is not installed")
    cases = json.dumps([(*case, PIXELS.tolist()) for case in CASES])
    run = [sys.executable, "-c", SCRIPT]
    done = subprocess.run(run, input=cases, capture_output=True, text=True, check=True)
    found, models = json.loads(done.stdout)
    return [np.array(points) for points, _ in found], models


def test_every_model_is_a_case():
    assert set(theirs()[1]) - {"EQUIRECTANGULAR"} == {model for model, _ in CASES}


@pytest.mark.parametrize("case", range(len(CASES)), ids=[model for model, _ in CASES])
def test_pixels_and_rays_are_those_of_pycolmap(case: int):
    model, params = CASES[case]
    camera = Camera.from_colmap(model, *SIZE, tuple(params))
    most = 1e-6 if model in MODELS else 0.1
    rays = np.column_stack([theirs()[0][case], np.ones(len(PIXELS))])
    np.testing.assert_allclose(camera.img_from_cam(rays) + 0.5, PIXELS, atol=most)
    seen = camera.normalized_from_img(PIXELS - 0.5)
    np.testing.assert_allclose(
        camera.img_from_cam(np.column_stack([seen, rays[:, 2]])) + 0.5, PIXELS
    )
    if model in MODELS:
        assert camera.to_colmap() == (model, *SIZE, tuple(params))


@pytest.mark.parametrize(
    ("model", "params", "says"),
    [
        ("FOV", [400.0, 400.0, 320.0, 240.0], "FOV takes 5 finite numbers, not 4"),
        ("EUCM", [400.0, 400.0, 320.0, 240.0, float("nan"), 1.0], "EUCM takes 6 finite numbers"),
        (
            "THIN_PRISM_FISHEYE",
            [400.0, 400.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.01, 0.0],
            "THIN_PRISM_FISHEYE .* pixels off .*; undistort the images",
        ),
        ("FOV", [400.0, 400.0, 9000.0, 240.0, 0.9], "FOV .*; undistort"),
        ("EQUIRECTANGULAR", [640.0, 480.0], "'EQUIRECTANGULAR'; undistort the images"),
    ],
)
def test_what_no_model_gives_is_refused_with_a_remedy(model: str, params: list[float], says: str):
    with pytest.raises(CalibrationError, match=says) as caught:
        Camera.from_colmap(model, *SIZE, tuple(params))
    assert "\n" not in str(caught.value)
