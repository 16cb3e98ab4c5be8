"""Test calibrations of other programs: each gives the camera that it means, or a line that names
its kind, the file and a remedy."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from topoloc.errors import CalibrationError
from topoloc.geometry.camera import Camera
from topoloc.recordings.calibration import parse_calibration
from topoloc.recordings.camera_files import CameraCalibration

Read = Callable[..., CameraCalibration]
PINHOLE = Camera.pinhole(64, 48, 40.0, 41.0, 31.5, 23.5)
K = [[40.0, 0.0, 31.5], [0.0, 41.0, 23.5], [0.0, 0.0, 1.0]]
BENDS = [-0.1, 0.02, 0.001, -0.002, 0.003]
DISTORTED = Camera("FULL_OPENCV", 64, 48, (40.0, 41.0, 31.5, 23.5, *BENDS, 0.0, 0.0, 0.0))
REALSENSE: dict[str, Any] = {
    "width": 64,
    "height": 48,
    "fx": 40.0,
    "fy": 41.0,
    "ppx": 31.5,
    "ppy": 23.5,
    "model": "distortion.inverse_brown_conrady",
    "coeffs": [0.0] * 5,
}


@pytest.fixture
def read(tmp_path: Path) -> Read:
    """Return a function that writes a file and reads the calibration of images of 64x48."""

    def read(content: Any, name: str = "camera.txt") -> CameraCalibration:
        text = content if isinstance(content, str) else json.dumps(content)
        (tmp_path / name).write_text(text)
        return parse_calibration(tmp_path / name)(64, 48)

    return read


def ost(name: str, distortion: str, baseline: float = 0.0) -> str:
    return (
        f"\n[{name}]\n\ncamera matrix\n40.0 0.0 31.5\n0.0 41.0 23.5\n0.0 0.0 1.0\n\ndistortion\n"
        f"{distortion}\n\nrectification\n1 0 0\n0 1 0\n0 0 1\n\nprojection\n"
        f"40.0 0.0 31.5 {-40.0 * baseline}\n0.0 41.0 23.5 0.0\n0.0 0.0 1.0 0.0\n"
    )


OST_HEAD = "# oST version 5.0 parameters\n\n\n[image]\n\nwidth\n64\n\nheight\n48\n"


@pytest.mark.parametrize(
    ("content", "camera"),
    [
        ("# id model\n1 PINHOLE 64 48 40 41 32 24\n", PINHOLE),
        ("2 PINHOLE 640 480 400 410 320 240\n1 PINHOLE 64 48 40 41 32 24\n", PINHOLE),
        (
            "7 RADIAL 64 48 4e1 32 24 -0.1 .02",
            Camera("RADIAL", 64, 48, (40.0, 31.5, 23.5, -0.1, 0.02)),
        ),
        (OST_HEAD + ost("narrow_stereo", "0 0 0 0 0"), PINHOLE),
        (OST_HEAD + ost("head/left", " ".join(map(str, BENDS))), DISTORTED),
        ("1 PINHOLE 64 48 40 41 32 24\n2 EQUIRECTANGULAR 8 4 8 4", PINHOLE),
        ("40 0 31.5\n0 41 23.5\n0 0 1\n", PINHOLE),
        ("40.0, 0.0, 31.5, 0.0, 41.0, 23.5, 0.0, 0.0, 1.0", PINHOLE),
        (f"K = {np.array(K)}", PINHOLE),
        ("40 0 31.5 0\n0 41 23.5 0\n0 0 1 0\n0 0 0 1\n", PINHOLE),  # as ScanNet has it
        (K, PINHOLE),
        (
            {"width": 64, "height": 48, "intrinsic_matrix": np.transpose(K).ravel().tolist()},
            PINHOLE,
        ),
        (
            {"intrinsic": {"width": 64, "height": 48, "intrinsic_matrix": np.ravel(K).tolist()}},
            PINHOLE,
        ),
        ({"camera_matrix": K, "dist_coeff": [BENDS]}, DISTORTED),
        ({"mtx": K, "dist": [], "image_width": 64, "image_height": 48}, PINHOLE),
        (REALSENSE, PINHOLE),
        ({"color": REALSENSE | {"model": "Inverse Brown Conrady"}, "serial": "1"}, PINHOLE),
        (REALSENSE | {"model": 2}, PINHOLE),
        (REALSENSE | {"model": "distortion.brown_conrady", "coeffs": BENDS}, DISTORTED),
        (
            REALSENSE | {"model": "RS2_DISTORTION_KANNALA_BRANDT4", "coeffs": [0.1, 0.2, 0, 0, 0]},
            Camera("OPENCV_FISHEYE", 64, 48, (40.0, 41.0, 31.5, 23.5, 0.1, 0.2, 0.0, 0.0)),
        ),
    ],
)
def test_files_of_other_programs(read: Read, content: Any, camera: Camera):
    for name in ("camera.txt", "camera.json"):
        assert read(content, name).camera == camera


def test_ost_of_a_pair(read: Read):
    bends = " ".join(map(str, BENDS))
    calibration = read(OST_HEAD + ost("head/left", bends) + ost("head/right", bends, 0.12))
    assert calibration.camera == DISTORTED
    assert calibration.rig is not None
    assert calibration.rig.baseline == pytest.approx(0.12)


def test_yaml_under_another_name(read: Read):
    text = f"%YAML:1.0\nimage_width: 64\nimage_height: 48\ncamera_matrix: {K}\n"
    assert read(text, "calibration.txt").camera.intrinsics == PINHOLE.intrinsics


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("1 EQUIRECTANGULAR 64 48 64 48\n", "model 'EQUIRECTANGULAR'; undistort the images"),
        (
            "1 PINHOLE 60 48 40 41 30 24\n2 PINHOLE 60 48 40 42 30 24",
            "2 cameras of COLMAP .*; keep",
        ),
        (
            OST_HEAD + ost("camera", "0.1 0.2 0 0"),
            "4 coefficients .* OPENCV_FISHEYE; write a camera",
        ),
        (OST_HEAD + ost("left", "0 0 0 0 0") + ost("right", "0 0 0 0 0"), "2 cameras, but no"),
        (OST_HEAD.replace("64", "wide") + ost("left", "0"), "could not convert"),
        ({"K": K, "D": [0.1, 0.2, 0.0, 0.0]}, "4 coefficients"),
        ("1 0 0\n0 1 0\n0.1 0.2 0.3\n", "no camera matrix, whose rows are fx 0 cx"),
        ("400 0 319.5\n0 400 239.5\n0 0 1\n", "a picture of about 640x480"),
        ({"camera_matrix": [[400, 0, 319.5], [0, 400, 239.5], [0, 0, 1]]}, "about 640x480"),
        ("40 2 31.5\n0 41 23.5\n0 0 1\n", "a skew of 2"),
        (REALSENSE | {"coeffs": BENDS}, "inverse_brown_conrady with these .*; calibrate"),
        ({"color": REALSENSE, "depth": REALSENSE}, r"several cameras \(color, depth\); write one"),
        ({"value0": {"intrinsics": [{"camera_type": "ds"}]}}, "Basalt is not read; write a camera"),
        ({"v2 unknown": {"projection_type": "brown"}}, "OpenSfM are not read; write a camera.json"),
        ("40 41 31.5 23.5\n", "no known calibration; write a camera.json .* fx,fy,cx,cy"),
        ("<opencv_storage/>", "no known calibration; write a camera.json"),
    ],
)
def test_what_is_not_read_is_named_in_one_line(read: Read, content: Any, says: str):
    with pytest.raises(CalibrationError, match=says) as raised:
        read(content)
    assert "\n" not in str(raised.value)


def test_colmaps_binary_file(tmp_path: Path):
    (tmp_path / "cameras.bin").write_bytes(b"\1\0\0\0\0\0\0\0\xff")
    with pytest.raises(CalibrationError, match=r"cameras\.bin: .* model_converter"):
        parse_calibration(tmp_path / "cameras.bin")
