"""Check that settings files shipped with VINS-Mono, VINS-Fusion, ORB-SLAM2 and ORB-SLAM3 are read
as calibrations."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tiny_recordings import HEIGHT, WIDTH, picture, write
from topoloc.apps.cli import main
from topoloc.errors import CalibrationError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.recordings.calibration import parse_calibration
from topoloc.recordings.camera_files import CameraCalibration
from topoloc.recordings.open import open_sequence

Read = Callable[[str], CameraCalibration]
EUROC = (458.654, 457.296, 367.215, 248.375, -0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
RIGHT_FROM_LEFT = Rigid3(exp_so3(np.array([0.01, -0.02, 0.005])), np.array([-0.11, 0.001, 0.002]))
BODY_FROM_LEFT = Rigid3(exp_so3(np.array([0.1, 1.5, 0.2])), np.array([-0.02, -0.06, 0.01]))


def matrix(key: str, rows: np.ndarray, kind: str = "d") -> str:
    data = ", ".join(f"{value:.9g}" for value in rows.ravel())
    shape = f"   rows: {rows.shape[0]}\n   cols: {rows.shape[1]}\n   dt: {kind}\n"
    return f"{key}: !!opencv-matrix\n{shape}   data: [{data}]\n"


VINS_PINHOLE = """%YAML:1.0
---
imu_topic: "/imu0"
image_topic: "/cam0/image_raw"

#camera calibration
model_type: PINHOLE
camera_name: camera
image_width: 752
image_height: 480
distortion_parameters:
   k1: -0.28340811
   k2: 0.07395907
   p1: 0.00019359
   p2: 1.76187114e-05
projection_parameters:
   fx: 458.654
   fy: 457.296
   cx: 367.215
   cy: 248.375

estimate_extrinsic: 0
max_cnt: 150            # max feature number in feature tracking
"""
VINS_KANNALA = """%YAML:1.0
---
model_type: KANNALA_BRANDT
camera_name: cam1
image_width: 512
image_height: 512
projection_parameters:
   k2: 0.0034823894022493434
   k3: 0.0007150348452162257
   k4: -0.0020532361418706202
   k5: 0.00020293673591811182
   mu: 190.97847715128717
   mv: 190.9733070521226
   u0: 254.93170605935475
   v0: 256.8974428996504
"""
VINS_MEI = """%YAML:1.0
---
model_type: MEI
camera_name: camera
image_width: 752
image_height: 480
mirror_parameters:
   xi: 1.0
distortion_parameters:
   k1: -0.05
   k2: 0.02
   p1: 0.0001
   p2: -0.0001
projection_parameters:
   gamma1: 700.0
   gamma2: 699.0
   u0: 370.0
   v0: 240.0
"""
ORB3 = """%YAML:1.0

File.version: "1.0"

Camera.type: "PinHole"

# Camera calibration and distortion parameters (OpenCV)
Camera1.fx: 458.654
Camera1.fy: 457.296
Camera1.cx: 367.215
Camera1.cy: 248.375

Camera1.k1: -0.28340811
Camera1.k2: 0.07395907
Camera1.p1: 0.00019359
Camera1.p2: 1.76187114e-05

Camera.width: 752
Camera.height: 480

Camera.newWidth: 600
Camera.newHeight: 350

Camera.fps: 20
Camera.RGB: 1
"""
CAMERA2 = ORB3[ORB3.index("Camera1.fx") : ORB3.index("Camera.width")].replace("Camera1", "Camera2")
ORB2 = """%YAML:1.0

Camera.fx: 718.856
Camera.fy: 718.856
Camera.cx: 607.1928
Camera.cy: 185.2157

Camera.k1: 0.0
Camera.k2: 0.0
Camera.p1: 0.0
Camera.p2: 0.0

Camera.width: 1241
Camera.height: 376

# stereo baseline times fx
Camera.bf: 386.1448

ThDepth: 35
"""


@pytest.fixture
def calibration(tmp_path: Path) -> Read:
    """Return a function that reads a file with this text, for images of 752x480 if it does not
    give their size."""

    def read(text: str) -> CameraCalibration:
        (tmp_path / "settings.yaml").write_text(text)
        return parse_calibration(tmp_path / "settings.yaml")(752, 480)

    return read


@pytest.mark.parametrize("text", [VINS_PINHOLE, ORB3, ORB3.replace("Camera1", "Camera")])
def test_a_camera_with_radial_and_tangential_distortion(calibration: Read, text: str):
    found = calibration(text)
    assert found.camera == Camera("OPENCV", 752, 480, EUROC)
    assert found.rig is None


def test_fisheye_cameras(calibration: Read):
    ks = (0.0034823894022493434, 0.0007150348452162257, -0.0020532361418706202)
    params = (190.97847715128717, 190.9733070521226, 254.93170605935475, 256.8974428996504)
    camera = Camera("OPENCV_FISHEYE", 512, 512, (*params, *ks, 0.00020293673591811182))
    assert calibration(VINS_KANNALA).camera == camera
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")
    lines = [f"Camera1.{name}: {value!r}" for name, value in zip(names, camera.params, strict=True)]
    head = '%YAML:1.0\nFile.version: "1.0"\nCamera.type: "KannalaBrandt8"\n'
    text = head + "\n".join(lines) + "\nCamera.width: 512\nCamera.height: 512\n"
    assert calibration(text).camera == camera


def mei_pixels(points: np.ndarray) -> np.ndarray:
    """Project by the equations of Mei and Rives."""
    x, y, z = (points / np.linalg.norm(points, axis=1, keepdims=True)).T
    x, y = x / (z + 1.0), y / (z + 1.0)
    k1, k2, p1, p2, r2 = -0.05, 0.02, 0.0001, -0.0001, x * x + y * y
    radial = 1.0 + k1 * r2 + k2 * r2 * r2
    across = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    down = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.column_stack([700.0 * across + 370.0, 699.0 * down + 240.0])


def test_mei_is_replaced_by_the_nearest_fisheye(calibration: Read):
    camera = calibration(VINS_MEI).camera
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-1.0, 1.0, (500, 2)), np.ones(500)])
    expected = mei_pixels(points)
    seen = ((expected >= 0.0) & (expected <= [751.0, 479.0])).all(axis=1)
    assert seen.sum() > 100
    np.testing.assert_allclose(camera.img_from_cam(points[seen]), expected[seen], atol=0.5)
    with pytest.raises(CalibrationError, match=r"model_type MEI.*KANNALA_BRANDT"):
        calibration(VINS_MEI.replace("p1: 0.0001", "p1: 0.05"))


@pytest.mark.parametrize("num", [1, 2])
def test_vins_fusion_names_files_of_cameras(tmp_path: Path, calibration: Read, num: int):
    body_from_right = BODY_FROM_LEFT @ RIGHT_FROM_LEFT.inverse()
    text = f'%YAML:1.0\nimu: 1\nnum_of_cam: {num}\ncam0_calib: "cam0_pinhole.yaml"\n'
    text += 'cam1_calib: "cam1_pinhole.yaml"\n' * (num - 1) + "image_width: 752\n"
    text += matrix("body_T_cam0", BODY_FROM_LEFT.matrix())
    text += matrix("body_T_cam1", body_from_right.matrix())
    for number in range(num):
        (tmp_path / f"cam{number}_pinhole.yaml").write_text(VINS_PINHOLE)
    found = calibration(text)
    assert found.camera == Camera("OPENCV", 752, 480, EUROC)
    np.testing.assert_allclose(found.body_from_cam.matrix(), BODY_FROM_LEFT.matrix(), atol=1e-7)
    assert (found.rig is None) == (num == 1)
    if num == 2:
        pose = found.rig.right_from_left.matrix()
        np.testing.assert_allclose(pose, RIGHT_FROM_LEFT.matrix(), atol=1e-7)
    (tmp_path / "cam0_pinhole.yaml").unlink()
    with pytest.raises(CalibrationError, match=r"cam0_pinhole\.yaml"):
        calibration(text)
    with pytest.raises(CalibrationError, match="cam0_calib"):
        calibration(text.replace("cam0_pinhole", "../cam0_pinhole"))


@pytest.mark.parametrize("key", ["Stereo.T_c1_c2", "Tlr"])
def test_a_pair_of_orb_slam3(calibration: Read, key: str):
    left_from_right = RIGHT_FROM_LEFT.inverse().matrix()[: 4 if key.startswith("S") else 3]
    rig = calibration(ORB3 + CAMERA2 + matrix(key, left_from_right, "f")).rig
    assert rig.left == rig.right == Camera("OPENCV", 752, 480, EUROC)
    np.testing.assert_allclose(rig.right_from_left.matrix(), RIGHT_FROM_LEFT.matrix(), atol=1e-7)


def test_rectified_pairs(calibration: Read):
    rig = calibration(ORB2).rig
    assert rig.left == Camera.pinhole(1241, 376, 718.856, 718.856, 607.1928, 185.2157)
    assert rig.baseline == pytest.approx(386.1448 / 718.856)
    three = ORB2.replace("Camera.f", "Camera1.f").replace("Camera.c", "Camera1.c")
    three = three.replace("Camera.bf: 386.1448", "Stereo.b: 0.54") + 'Camera.type: "Rectified"\n'
    assert calibration(three).rig.baseline == pytest.approx(0.54)
    with pytest.raises(CalibrationError, match=r"Camera\.bf .*Camera\.k1"):
        calibration(ORB2.replace("k1: 0.0", "k1: -0.2"))


def test_a_pair_of_orb_slam2_that_is_not_rectified(calibration: Read):
    k = np.array([[458.654, 0.0, 367.215], [0.0, 457.296, 248.375], [0.0, 0.0, 1.0]])
    d, size = np.array([EUROC[4:]]), (752, 480)
    motion = RIGHT_FROM_LEFT.rotation, RIGHT_FROM_LEFT.translation[:, None]
    r1, r2, p1, p2, *_ = cv2.stereoRectify(k, d, k, d, size, *motion)
    text = f"%YAML:1.0\nCamera.fx: {p1[0, 0]}\nCamera.bf: 47.9\nCamera.width: 752\n"
    for side, rotation, projection in (("LEFT", r1, p1), ("RIGHT", r2, p2)):
        text += f"{side}.height: 480\n{side}.width: 752\n" + matrix(f"{side}.D", d)
        text += matrix(f"{side}.K", k) + matrix(f"{side}.R", rotation)
        text += matrix(f"{side}.P", projection)
    rig = calibration(text).rig
    assert rig.left == rig.right == Camera("OPENCV", 752, 480, EUROC)
    np.testing.assert_allclose(rig.right_from_left.matrix(), RIGHT_FROM_LEFT.matrix(), atol=1e-6)
    with pytest.raises(CalibrationError, match=r"RIGHT\.K with 9 numbers is missing"):
        calibration(text.replace("RIGHT.K", "RIGHT.X"))


def test_depth_of_orb_slam(calibration: Read):
    """In these files, bf belongs to a projector."""
    for key in ("DepthMapFactor", "RGBD.DepthMapFactor"):
        found = calibration(ORB2 + f"{key}: 5000.0\n")
        assert (found.rig, found.depth_factor) == (None, 5000.0)
    with pytest.raises(CalibrationError, match="DepthMapFactor"):
        calibration(ORB2 + "DepthMapFactor: -1.0\n")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (VINS_PINHOLE.replace("PINHOLE", "SCARAMUZZA"), "model_type SCARAMUZZA is not one of"),
        (VINS_PINHOLE.replace("   fy:", "   fyy:"), "projection_parameters: fy is missing"),
        (VINS_PINHOLE.replace("   k2:", "   kk:"), "distortion_parameters: k2 is missing"),
        (VINS_PINHOLE.replace("fx: 458.654", "fx: -458.654"), "focal length"),
        (VINS_MEI.replace("xi: 1.0", "xi: none"), "mirror_parameters: xi is missing"),
        (ORB3.replace("PinHole", "Omni"), r"Camera\.type Omni is not one of PinHole, Rectified"),
        (ORB3.replace("Camera1.cy", "Camera1.c"), r"Camera1\.cy is missing"),
        (ORB3.replace("PinHole", "KannalaBrandt8"), r"Camera1\.k3 is missing"),
        (ORB3 + matrix("Stereo.T_c1_c2", np.eye(4)), r"Camera2\.fx is missing"),
        (ORB3 + CAMERA2 + matrix("Stereo.T_c1_c2", 2.0 * np.eye(4)), r"Stereo\.T_c1_c2"),
        (ORB2.replace("386.1448", "386144.8"), "a baseline of 537.166 m; is it in millimetres"),
    ],
)
def test_faults_name_their_key_in_one_line(calibration: Read, text: str, says: str):
    with pytest.raises(CalibrationError, match=r"settings\.yaml.*" + says) as raised:
        calibration(text)
    assert "\n" not in str(raised.value)


def test_a_recording_with_such_files_beside_it(tmp_path: Path):
    for name in ("left", "right"):
        for index in range(2):
            write(tmp_path / name / f"{index}.png", picture(index))
    small = VINS_PINHOLE.replace("752", str(WIDTH)).replace("480", str(HEIGHT))
    for old, new in {"458.654": "40", "457.296": "40", "367.215": "16", "248.375": "12"}.items():
        small = small.replace(old, new)
    for number in (0, 1):
        (tmp_path / f"cam{number}.yaml").write_text(small)
    right = BODY_FROM_LEFT @ RIGHT_FROM_LEFT.inverse()
    text = "%YAML:1.0\ncam0_calib: cam0.yaml\ncam1_calib: cam1.yaml\n"
    text += matrix("body_T_cam0", BODY_FROM_LEFT.matrix()) + matrix("body_T_cam1", right.matrix())
    (tmp_path / "euroc_stereo_config.yaml").write_text(text)
    rig = open_sequence(tmp_path)[0].rig
    assert rig is not None
    assert rig.baseline == pytest.approx(np.linalg.norm(RIGHT_FROM_LEFT.translation))


def test_build_and_localize_with_the_settings_of_orb_slam(
    tiny_recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """The recording is KITTI-like, but without calib.txt."""
    recording = Path(shutil.copytree(tiny_recording, tmp_path / "walk"))
    frame = open_sequence(recording)[0]
    assert frame.camera is not None
    assert frame.rig is not None
    (recording / "calib.txt").unlink()
    numbers = (*frame.camera.params, frame.camera.width, frame.camera.height)
    keys = ("fx", "fy", "cx", "cy", "width", "height")
    lines = [f"Camera.{key}: {value!r}" for key, value in zip(keys, numbers, strict=True)]
    bf = f"Camera.bf: {frame.camera.fx * frame.rig.baseline!r}"
    text = "%YAML:1.0\n" + "\n".join([*lines, bf]) + "\n"
    (tmp_path / "orb.yaml").write_text(text)
    out, camera = str(tmp_path / "m.topo"), ["--camera", str(tmp_path / "orb.yaml")]
    assert main(["build", str(recording), out, "--features", "surf", *camera]) == 0
    image = str(recording / "image_0" / "000003.png")
    capsys.readouterr()
    assert main(["localize", out, image, *camera]) == 0
    assert " p 1.00" in capsys.readouterr().out
