"""Test calibrations of two distorted cameras: camera.json, YAML written by OpenCV, Kalibr's
camchain, and four numbers."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tiny_recordings import CALIB, CAMERA, HEIGHT, WIDTH, picture, write
from topoloc.errors import CalibrationError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import StereoRig
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.recordings.camera_files import read_calibration_yaml
from topoloc.recordings.frame import StereoFrame
from topoloc.recordings.open import open_sequence

LEFT = Camera("OPENCV", WIDTH, HEIGHT, (40.0, 41.0, 15.5, 11.5, -0.1, 0.02, 0.001, -0.002))
RIGHT = Camera(
    "FULL_OPENCV",
    WIDTH,
    HEIGHT,
    (42.0, 43.0, 14.5, 12.5, -0.12, 0.03, 0.0, 0.001, 0.01, 0.0, 0.0, 0.0),
)
RIGHT_FROM_LEFT = Rigid3(exp_so3(np.array([0.01, -0.02, 0.005])), np.array([-0.12, 0.001, 0.002]))

KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.1, 0.02, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [40.0, 41.0, 15.5, 11.5]
  resolution: [32, 24]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
{rows}
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [0.01, -0.002, 3.0e-05, 1.e-05]
  distortion_model: equidistant
  intrinsics: [42.0, 43.0, 14.5, 12.5]
  resolution: [32, 24]
  rostopic: /cam1/image_raw
"""


def kalibr_text(right_from_left: Rigid3 = RIGHT_FROM_LEFT) -> str:
    return KALIBR.format(
        rows="\n".join("  - " + str(row) for row in right_from_left.matrix().tolist())
    )


def write_opencv(
    path: Path, names: tuple[str, ...] = ("M1", "D1", "M2", "D2", "R", "T"), scale: float = 1.0
) -> Path:
    matrices = (
        LEFT.matrix(),
        LEFT.distortion()[None, :4],
        RIGHT.matrix(),
        RIGHT.distortion()[None, :5],
    )
    values = (*matrices, RIGHT_FROM_LEFT.rotation, RIGHT_FROM_LEFT.translation[:, None] * scale)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in zip(names, values, strict=False):
        storage.write(name, value)
    storage.release()
    return path


@pytest.fixture
def pairs(tmp_path: Path) -> Path:
    """Return a folder with three stereo pairs and no calibration."""
    for index in range(3):
        write(tmp_path / "pairs" / "left" / f"{index}.png", picture(index))
        write(tmp_path / "pairs" / "right" / f"{index}.png", picture(10 + index))
    return tmp_path / "pairs"


def _assert_rig(
    frame: StereoFrame, left: Camera, right: Camera, right_from_left: Rigid3 = RIGHT_FROM_LEFT
) -> None:
    assert frame.rig is not None
    assert frame.camera == frame.rig.left == left
    assert frame.rig.right == right
    np.testing.assert_allclose(
        frame.rig.right_from_left.matrix(), right_from_left.matrix(), atol=1e-9
    )


def test_two_cameras_in_camera_json(pairs: Path):
    data = {
        "left": LEFT.to_json(),
        "right": RIGHT.to_json(),
        "right_from_left": RIGHT_FROM_LEFT.matrix().tolist(),
    }
    (pairs / "camera.json").write_text(json.dumps(data))
    _assert_rig(open_sequence(pairs)[1], LEFT, RIGHT)
    for key in data:
        (pairs / "camera.json").write_text(
            json.dumps({name: value for name, value in data.items() if name != key})
        )
        with pytest.raises(CalibrationError, match=rf"camera\.json: .*{key}"):
            open_sequence(pairs)
    (pairs / "camera.json").write_text(json.dumps(data | {"right": {"width": 3}}))
    with pytest.raises(CalibrationError, match=r"camera\.json: right: "):
        open_sequence(pairs)


def test_yaml_written_by_opencv(pairs: Path):
    write_opencv(pairs / "stereo.yml")
    _assert_rig(open_sequence(pairs)[0], LEFT, RIGHT)


def test_opencvs_two_files(pairs: Path, tmp_path: Path):
    """OpenCV's stereo sample writes cameras to intrinsics.yml and their transform to
    extrinsics.yml."""
    whole = write_opencv(tmp_path / "whole.yml").read_text()
    (pairs / "intrinsics.yml").write_text(whole[: whole.index("\nR:")] + "\n")
    (pairs / "extrinsics.yml").write_text("%YAML:1.0\n---" + whole[whole.index("\nR:") :])
    _assert_rig(open_sequence(pairs)[0], LEFT, RIGHT)


def test_longer_names_and_camera_from_elsewhere(pairs: Path, tmp_path: Path):
    names = (
        "camera_matrix_left",
        "distortion_coefficients_left",
        "camera_matrix_right",
        "distortion_coefficients_right",
        "R",
        "T",
    )
    file = write_opencv(tmp_path / "rig.yaml", names)
    _assert_rig(open_sequence(pairs, camera=file)[0], LEFT, RIGHT)


def test_kalibr(pairs: Path):
    (pairs / "camchain.yaml").write_text(kalibr_text())
    right = Camera(
        "OPENCV_FISHEYE", WIDTH, HEIGHT, (42.0, 43.0, 14.5, 12.5, 0.01, -0.002, 3e-05, 1e-05)
    )
    _assert_rig(open_sequence(pairs)[0], LEFT, right)


def test_a_camera_of_ros(tmp_path: Path):
    write(tmp_path / "walk" / "0.png", picture(0))
    (tmp_path / "walk" / "head.yaml").write_text(
        "image_width: 32\nimage_height: 24\ncamera_name: head\ncamera_matrix:\n  rows: 3\n  cols:"
        " 3\n  data: [40., 0, 15.5, 0, 41, 11.5, 0, 0, 1]\ndistortion_model:"
        " plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [-0.1, 0.02, 0.001,"
        " -0.002, 0]\n"
    )
    assert open_sequence(tmp_path / "walk")[0].camera == LEFT


ROS = """image_width: 32
image_height: 24
camera_name: {name}
camera_matrix:
  rows: 3
  cols: 3
  data: {k}
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: {d}
rectification_matrix:
  rows: 3
  cols: 3
  data: {r}
projection_matrix:
  rows: 3
  cols: 4
  data: {p}
"""


@pytest.mark.parametrize("given", [False, True])
def test_the_two_files_of_ros(pairs: Path, given: bool):
    """ROS's cameracalibrator stores the baseline in P of the right camera."""
    rotation, translation = RIGHT_FROM_LEFT.rotation, RIGHT_FROM_LEFT.translation[:, None]
    cameras = (LEFT, RIGHT)
    matrices = [(camera.matrix(), camera.distortion()[:5]) for camera in cameras]
    r_left, r_right, p_left, p_right, *_ = cv2.stereoRectify(
        *matrices[0], *matrices[1], (WIDTH, HEIGHT), rotation, translation
    )
    names, parts = ("left", "right"), ((r_left, p_left), (r_right, p_right))
    for name, (k, d), (r, p) in zip(names, matrices, parts, strict=True):
        numbers = {"k": k, "d": d, "r": r, "p": p}
        text = {key: value.ravel().tolist() for key, value in numbers.items()}
        (pairs / f"{name}.yaml").write_text(ROS.format(name=name, **text))
    sequence = open_sequence(pairs, camera=pairs / "left.yaml" if given else None)
    _assert_rig(sequence[0], LEFT, RIGHT)


def test_several_calibrations_and_other_yaml(pairs: Path, tmp_path: Path):
    (pairs / "notes.yaml").write_text("weather: [1, 2]\n")
    write_opencv(pairs / "one.yml")
    _assert_rig(open_sequence(pairs)[0], LEFT, RIGHT)
    (pairs / "two.yaml").write_text(kalibr_text())
    with pytest.raises(
        CalibrationError,
        match=r"several calibrations \(one\.yml, two\.yaml\); name one with --camera",
    ):
        open_sequence(pairs)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            lambda text: text.replace("pinhole", "omni"),
            r"camera_model omni .*--models pinhole-equi",
        ),
        (lambda text: text.replace("pinhole", "ds"), r"camera_model ds \(double sphere\)"),
        (lambda text: text.replace("radtan", "fov"), "distortion_model fov is not one of"),
        (lambda text: text.replace("T_cn_cnm1", "T_other"), "T_cn_cnm1 with 16 numbers is missing"),
        (
            lambda text: text.replace("[40.0, 41.0,", "[.nan, 41.0,"),
            "intrinsics with 4 numbers is missing",
        ),
        (lambda text: text.replace("[40.0,", "[1e999,"), "not finite"),
        (
            lambda text: text.replace("resolution: [32, 24]", "resolution: [1e999, 24]"),
            "camchain.yaml",
        ),
        (
            lambda text: text.replace("-0.12]", "-120.0]"),
            "a baseline of 120 m; is it in millimetres",
        ),
        (lambda text: text.replace("0.9997", "0.5", 1), "no rotation"),
        (lambda text: text + "x" * 1_000_001, "are no calibration"),
    ],
)
def test_broken_kalibr(pairs: Path, tmp_path: Path, change: Callable[[str], str], says: str):
    file = tmp_path / "camchain.yaml"
    changed = change(kalibr_text())
    assert changed != kalibr_text()
    file.write_text(changed)
    with pytest.raises(CalibrationError, match=says) as raised:
        open_sequence(pairs, camera=file)
    assert "camchain.yaml" in str(raised.value)


def test_broken_opencv(pairs: Path, tmp_path: Path):
    file = write_opencv(tmp_path / "rig.yml", scale=1000.0)
    with pytest.raises(
        CalibrationError, match=r"rig\.yml: a baseline of 120\.0\d+ m; is it in millimetres"
    ):
        open_sequence(pairs, camera=file)
    write_opencv(file, ("M1", "D1", "M2", "D2"))
    with pytest.raises(CalibrationError, match=r"rig\.yml: R .* with 9 numbers is missing"):
        open_sequence(pairs, camera=file)
    file.write_text("[" * 100_000)
    with pytest.raises(CalibrationError, match=r"rig\.yml: camera_matrix"):
        open_sequence(pairs, camera=file)


class TestCameraOption:
    """Test a calibration that replaces the recording's own."""

    def test_of_a_rectified_pair_the_baseline_stays(self, kitti: Path):
        frame = open_sequence(kitti, camera="45,46,16,12")[0]
        assert frame.camera == Camera.pinhole(WIDTH, HEIGHT, 45.0, 46.0, 16.0, 12.0)
        assert frame.rig is not None
        assert frame.rig.left == frame.rig.right == frame.camera
        assert frame.rig.baseline == pytest.approx(0.2)
        assert "P1: 50 0 16 -10" in CALIB

    def test_a_pair_that_is_not_rectified_needs_both(self, euroc: Path, tmp_path: Path):
        with pytest.raises(CalibrationError, match=r"not rectified.* needs a file of both cameras"):
            open_sequence(euroc, camera="45,46,16,12")
        _assert_rig(open_sequence(euroc, camera=write_opencv(tmp_path / "rig.yml"))[0], LEFT, RIGHT)

    def test_registered_depth_goes_with_its_picture(self, plain: Callable[..., Path]):
        frame = open_sequence(plain("rgb", "depth", depth_factor=1000), camera="45,46,16,12")[1]
        assert frame.depth is not None
        assert (
            frame.camera
            == frame.depth.camera
            == Camera.pinhole(WIDTH, HEIGHT, 45.0, 46.0, 16.0, 12.0)
        )
        np.testing.assert_allclose(frame.depth.depth, 0.2, rtol=1e-6)

    def test_a_missing_value_is_named(self, plain: Callable[..., Path]):
        with pytest.raises(CalibrationError, match="depth_factor"):
            open_sequence(plain("rgb", "depth"), camera="45,46,16,12")
        with pytest.raises(CalibrationError, match="baseline"):
            open_sequence(plain("left", "right"), camera="45,46,16,12")

    def test_a_file_with_a_depth_factor(self, plain: Callable[..., Path], tmp_path: Path):
        (tmp_path / "mine.json").write_text(json.dumps(CAMERA | {"fx": 50.0, "depth_factor": 2000}))
        depth = open_sequence(plain("rgb", "depth"), camera=tmp_path / "mine.json")[1].depth
        assert depth is not None
        assert depth.camera.fx == 50.0
        np.testing.assert_allclose(depth.depth, 0.1, rtol=1e-6)

    def test_tum(self, tum: Path):
        frame = open_sequence(tum, camera="500,500,320,240")[0]
        assert (
            frame.camera
            == frame.depth.camera
            == Camera.pinhole(640, 480, 500.0, 500.0, 320.0, 240.0)
        )  # pyright: ignore[reportOptionalMemberAccess]

    def test_a_format_that_keeps_its_own_depth_camera(self, seven_scenes: Path):
        frame = open_sequence(seven_scenes, camera="520,520,320,240")[0]
        assert frame.depth is not None
        assert (frame.camera and frame.camera.fx, frame.depth.camera.fx) == (520, 585)

    @pytest.mark.parametrize(
        ("numbers", "says"),
        [
            ("80,80,31.5,23.5", "are those of a picture of about 64x48 pixels; this one has 32x24"),
            ("20,20,7.5,5.5", "are those of a picture of about 16x12 pixels; this one has 32x24"),
            (
                "40,40,11.5,15.5",
                "are those of a picture turned by 90 degrees, of about 24x32; this one has 32x24",
            ),
            ("40,40,500,11.5", "are those of a picture of about 1001x24 pixels"),
            ("40,40,15.5", "neither a file nor four numbers"),
            ("40,40,nan,11.5", "not finite"),
            ("-40,40,15.5,11.5", "positive"),
        ],
    )
    def test_numbers_of_another_picture(self, kitti: Path, numbers: str, says: str):
        with pytest.raises(CalibrationError, match=says):
            open_sequence(kitti, camera=numbers)

    def test_a_principal_point_somewhat_off_is_accepted(self, kitti: Path):
        assert open_sequence(kitti, camera="45,46,18,10.5")[0].camera == Camera.pinhole(
            WIDTH, HEIGHT, 45.0, 46.0, 18.0, 10.5
        )


def test_a_distorted_pair_is_rectified_as_its_calibration():
    """Rectified cameras see a point of the raw cameras in equal rows, at the
    disparity of its depth."""
    from topoloc.geometry.rig import rectify

    rig = StereoRig(LEFT, RIGHT, RIGHT_FROM_LEFT)
    rectified = rectify(rig)
    points = np.array([[0.1, 0.05, 2.0], [-0.2, 0.1, 3.0]])
    in_rectified = rectified.rectified_from_left.apply(points)
    left = rectified.rig.left.img_from_cam(in_rectified)
    right = rectified.rig.right.img_from_cam(rectified.rig.right_from_left.apply(in_rectified))
    np.testing.assert_allclose(left[:, 1], right[:, 1], atol=1e-9)
    np.testing.assert_allclose(
        left[:, 0] - right[:, 0],
        rectified.rig.left.fx * rig.baseline / in_rectified[:, 2],
        atol=1e-9,
    )


def test_a_lens_of_kalibrs_unified_model(tmp_path: Path):
    path = tmp_path / "camchain.yaml"
    path.write_text(
        "cam0:\n  camera_model: eucm\n  distortion_model: none\n"
        "  intrinsics: [0.6, 1.1, 300.0, 310.0, 321.0, 241.0]\n  resolution: [640, 480]\n"
    )
    camera = read_calibration_yaml(path, 640, 480).camera
    points = np.array([[0.3, -0.2, 1.0], [-0.6, 0.4, 1.0], [0.0, 0.0, 2.0]])
    x, y, z = points.T
    depth = 0.6 * np.sqrt(1.1 * (x * x + y * y) + z * z) + 0.4 * z
    pixels = np.column_stack([300.0 * x / depth + 321.0, 310.0 * y / depth + 241.0])
    np.testing.assert_allclose(camera.img_from_cam(points), pixels, atol=0.1)
