"""Test calibrations in messages: camera models, raw or rectified images, and pairs as OpenCV
rectifies them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from topoloc.apps.formats.bags.bag_images import camera_info
from topoloc.apps.formats.calibrations.ros_calibration import RosCalibration
from topoloc.errors import CalibrationError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import exp_so3

K = np.array([[500.0, 0, 320], [0, 505, 240], [0, 0, 1]])


def info(**fields: Any) -> RosCalibration:
    p = np.column_stack([np.diag([480.0, 480, 1]), np.zeros(3)])
    p[:2, 2] = 319.0, 239.0
    its = {
        "header": SimpleNamespace(frame_id="/cam"),
        "width": 640,
        "height": 480,
        "distortion_model": "plumb_bob",
    }
    its |= {"d": [0.0] * 5, "k": K.ravel(), "r": np.eye(3).ravel(), "p": p.ravel()}
    return camera_info(SimpleNamespace(**(its | fields)), "/info")


@pytest.mark.parametrize(
    ("name", "coefficients", "model", "params"),
    [
        ("plumb_bob", [0.0] * 5, "PINHOLE", ()),
        ("", [], "PINHOLE", ()),
        ("plumb_bob", [0.1, -0.2, 0.001, 0.002, 0.0], "OPENCV", (0.1, -0.2, 0.001, 0.002)),
        (
            "plumb_bob",
            [0.1, -0.2, 0.001, 0.002, 0.3],
            "FULL_OPENCV",
            (0.1, -0.2, 0.001, 0.002, 0.3, 0.0, 0.0, 0.0),
        ),
        (
            "rational_polynomial",
            np.arange(1.0, 9.0),
            "FULL_OPENCV",
            (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0),
        ),
        ("equidistant", [0.1, 0.2, 0.3, 0.4], "OPENCV_FISHEYE", (0.1, 0.2, 0.3, 0.4)),
    ],
)
def test_models(name: str, coefficients: list[float], model: str, params: tuple[float, ...]):
    assert info(distortion_model=name, d=coefficients).camera(False) == Camera(
        model, 640, 480, (500.0, 505.0, 320.0, 240.0, *params)
    )


def test_rectified_pictures_are_of_p():
    assert info(d=[0.1] * 5).camera(True) == Camera.pinhole(640, 480, 480.0, 480.0, 319.0, 239.0)


def test_a_raw_pair_rectifies_as_its_calibration():
    """OpenCV's stereoRectify gives R and P of a rotated and shifted pair. The reader
    recovers the pair."""
    rotation, translation = exp_so3(np.array([0.01, -0.03, 0.02])), np.array([-0.12, 0.003, -0.002])
    distortion = np.array([0.1, -0.05, 0.001, -0.001, 0.0])
    r_left, r_right, p_left, p_right, *_ = cv2.stereoRectify(
        K, distortion, K, distortion, (640, 480), rotation, translation[:, None]
    )
    left = info(d=distortion, r=r_left.ravel(), p=p_left.ravel())
    right = info(d=distortion, r=r_right.ravel(), p=p_right.ravel())
    rig = left.rig(right, is_rectified=False)
    assert rig is not None
    np.testing.assert_allclose(rig.right_from_left.rotation, rotation, atol=1e-9)
    np.testing.assert_allclose(rig.right_from_left.translation, translation, atol=1e-9)
    assert rig.left.model == "OPENCV"
    with pytest.raises(CalibrationError, match="left and right swapped"):
        right.rig(left, is_rectified=True)
    assert left.rig(left, is_rectified=True) is None


@pytest.mark.parametrize(
    "fields",
    [
        {"k": [1.0, 2.0]},
        {"k": [np.nan] * 9},
        {"d": ["a"]},
        {"width": None},
        {"p": [1.0] * 11},
        {"r": np.ones(9), "k": np.ones(8)},
    ],
)
def test_invalid_calibrations_are_refused(fields: dict[str, Any]):
    with pytest.raises(CalibrationError, match="/info: no calibration"):
        info(**fields)


def test_unknown_models_are_refused():
    with pytest.raises(CalibrationError, match="distortion_model 'thin_prism' of 12 coefficients"):
        info(distortion_model="thin_prism", d=[0.1] * 12).camera(False)
    with pytest.raises(
        CalibrationError, match="/info: camera needs a positive size and focal length"
    ):
        info(k=np.zeros(9)).camera(False)
