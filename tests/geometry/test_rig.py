import functools
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from geometry_strategies import CAMERAS
from hypothesis import given, settings, strategies as st

from topoloc.errors import CalibrationError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import Rectification, StereoRig, rectify
from topoloc.geometry.rigid import Rigid3, exp_so3

BASELINE = 0.11
TILT = Rigid3.exp(np.array([-BASELINE, 0.004, -0.003, 0.01, -0.02, 0.015]))
WIDE = CAMERAS["OPENCV_FISHEYE"]
RIGS = {
    "pinhole": StereoRig(CAMERAS["PINHOLE"], CAMERAS["PINHOLE"].rescaled(1241, 376), TILT),
    "distorted": StereoRig(
        CAMERAS["OPENCV"],
        Camera(
            "OPENCV",
            752,
            480,
            (
                457.587,
                456.134,
                379.999,
                255.238,
                -0.28368365,
                0.07451284,
                -0.00010473,
                -3.55590700e-05,
            ),
        ),
        TILT,
    ),
    "fisheye": StereoRig(WIDE, WIDE, TILT),
    "unlike": StereoRig(CAMERAS["RADIAL"], WIDE, TILT),
}


@functools.cache
def rectification_of(name: str) -> Rectification:
    return rectify(RIGS[name])


def euroc_camera(path: Path) -> tuple[Camera, Rigid3]:
    """Return camera and body_from_cam of a sensor.yaml."""

    def numbers(key: str) -> list[float]:
        found = re.search(rf"^\s*{key}:[^\[]*\[([^\]]*)\]", text, re.MULTILINE)
        assert found, key
        return [float(value) for value in found[1].split(",")]

    text = path.read_text()
    width, height = numbers("resolution")
    camera = Camera(
        "OPENCV",
        int(width),
        int(height),
        (*numbers("intrinsics"), *numbers("distortion_coefficients")),
    )
    return camera, Rigid3.from_matrix(
        np.reshape(re.findall(r"[-\d.e]+", text.split("data: [")[1].split("]")[0]), (4, 4)).astype(
            float
        )
    )


def sample(image_map: np.ndarray, x: float, y: float) -> np.ndarray:
    """Interpolate the map between its pixels as remap does."""
    column, row = int(np.floor(x)), int(np.floor(y))
    a, b = x - column, y - row
    corners = image_map[row : row + 2, column : column + 2].astype(np.float64)
    return np.array([1 - b, b]) @ np.tensordot(corners, np.array([1 - a, a]), axes=([1], [0]))


@settings(max_examples=60)
@given(
    st.sampled_from(sorted(RIGS)),
    st.floats(0.02, 0.98),
    st.floats(0.02, 0.98),
    st.floats(0.5, 50.0),
)
def test_a_point_has_one_row_in_both_rectified_images(name, x, y, depth):
    rig, rectification = RIGS[name], rectification_of(name)
    rectified = rectification.rig
    pixel = np.array([[x * (rectified.left.width - 2), y * (rectified.left.height - 2)]])
    point_rectified = rectified.left.rays_from_img(pixel) * depth
    point_left = rectification.rectified_from_left.inverse().apply(point_rectified)
    # The rectified image samples this pixel at the point's pixel in the raw image.
    left_raw = rig.left.img_from_cam(point_left)[0]
    np.testing.assert_allclose(sample(rectification.left_map, *pixel[0]), left_raw, atol=1e-2)

    right_pixel = rectified.right.img_from_cam(rectified.right_from_left.apply(point_rectified))[0]
    assert right_pixel[1] == pytest.approx(pixel[0, 1], abs=1e-9)
    assert right_pixel[0] <= pixel[0, 0]
    if 0 <= right_pixel[0] < rectified.right.width - 1:
        right_raw = rig.right.img_from_cam(rig.right_from_left.apply(point_left))[0]
        np.testing.assert_allclose(
            sample(rectification.right_map, *right_pixel), right_raw, atol=1e-2
        )


@pytest.mark.parametrize("name", sorted(RIGS))
def test_rectified_images_have_no_black_border_and_waste_little(name):
    rig, rectification = RIGS[name], rectification_of(name)
    shares = []
    for camera, image_map in (
        (rig.left, rectification.left_map),
        (rig.right, rectification.right_map),
    ):
        white = np.full((camera.height, camera.width), 255, np.uint8)
        assert np.mean(cv2.remap(white, image_map, None, cv2.INTER_LINEAR) < 255) < 0.002
        shares.append(
            np.ptp(image_map[..., 0]) * np.ptp(image_map[..., 1]) / (camera.width * camera.height)
        )
    # The two cameras of "unlike" have different fields of view, and the wider one is cut to the
    # narrower.
    assert max(shares) > 0.75
    assert rectification.rig.is_rectified
    assert rectification.rig.baseline == pytest.approx(rig.baseline)


def test_rotation_and_view_agree_with_opencv():
    rig, rectification = RIGS["distorted"], rectification_of("distorted")
    motion = rig.right_from_left
    cameras = (
        rig.left.matrix(),
        rig.left.distortion(),
        rig.right.matrix(),
        rig.right.distortion(),
        (rig.left.width, rig.left.height),
    )
    rotation, _, projection, *_ = cv2.stereoRectify(
        *cameras,
        motion.rotation,
        motion.translation.reshape(3, 1),
        flags=cv2.CALIB_ZERO_DISPARITY,
        alpha=0,
    )
    np.testing.assert_allclose(rectification.rectified_from_left.rotation, rotation, atol=1e-9)
    assert rectification.rig.left.fx == pytest.approx(projection[0, 0], rel=0.05)


def test_a_rectified_rig_stays_as_it_is():
    rig = StereoRig.rectified(CAMERAS["PINHOLE"], 0.54)
    rectification = rectify(rig)
    assert rectification.rig.left == rig.left
    np.testing.assert_array_equal(rectification.rectified_from_left.rotation, np.eye(3))
    x, y = np.meshgrid(np.arange(1241), np.arange(376))
    np.testing.assert_allclose(rectification.left_map, np.stack([x, y], axis=2), atol=1e-3)


@pytest.mark.parametrize(
    ("translation", "message"),
    [
        ((0.1, 0.0, 0.0), "left and right look swapped"),
        ((0.0, -0.1, 0.0), "not side by side"),
        ((0.01, 0.02, -0.1), "not side by side"),
        ((0.0, 0.0, 0.0), "baseline of 0 m"),
        ((np.nan, 0.0, 0.0), "baseline of nan m"),
    ],
)
def test_rigs_that_are_not_left_and_right_are_refused(translation, message):
    with pytest.raises(CalibrationError, match=message):
        rectify(
            StereoRig(
                CAMERAS["OPENCV"], CAMERAS["OPENCV"], Rigid3(TILT.rotation, np.array(translation))
            )
        )


def test_cameras_of_different_sizes_are_refused():
    with pytest.raises(CalibrationError, match="sizes must agree"):
        rectify(StereoRig(CAMERAS["OPENCV"], CAMERAS["RADIAL"], TILT))


def test_cameras_that_look_away_from_each_other_are_refused():
    # Each turned outwards by 54 degrees, with a field of view of 79.
    half = exp_so3(np.array([0.0, 0.95, 0.0]))
    away = Rigid3(half @ half, half @ np.array([-0.1, 0.0, 0.0]))
    with pytest.raises(CalibrationError, match="hardly overlap"):
        rectify(StereoRig(CAMERAS["OPENCV"], CAMERAS["OPENCV"], away))


def load_grey(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None, path
    return image


def vertical_disparities(
    rectification: Rectification, left: np.ndarray, right: np.ndarray
) -> np.ndarray:
    sift = cv2.SIFT_create(800)
    left_key_points, left_descriptors = sift.detectAndCompute(
        cv2.remap(left, rectification.left_map, None, cv2.INTER_LINEAR), None
    )
    right_key_points, right_descriptors = sift.detectAndCompute(
        cv2.remap(right, rectification.right_map, None, cv2.INTER_LINEAR), None
    )
    pairs = cv2.BFMatcher().knnMatch(left_descriptors, right_descriptors, k=2)
    good = [best for best, second in pairs if best.distance < 0.7 * second.distance]
    return np.array(
        [left_key_points[m.queryIdx].pt[1] - right_key_points[m.trainIdx].pt[1] for m in good]
    )


def test_real_pair_has_equal_rows(shared):
    folder = shared / "data/euroc/v1_01_part/mav0"
    left, body_from_left = euroc_camera(folder / "cam0/sensor.yaml")
    right, body_from_right = euroc_camera(folder / "cam1/sensor.yaml")
    rectification = rectify(StereoRig(left, right, body_from_right.inverse() @ body_from_left))
    name = sorted(path.name for path in (folder / "cam0/data").glob("*.png"))[10]
    rows = vertical_disparities(
        rectification,
        load_grey(folder / "cam0/data" / name),
        load_grey(folder / "cam1/data" / name),
    )
    assert len(rows) > 100
    assert np.median(np.abs(rows)) < 0.5
