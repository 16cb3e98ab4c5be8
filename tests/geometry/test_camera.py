import json

import cv2
import numpy as np
import pytest
from geometry_strategies import CAMERAS, FISHEYE_195_DEG
from hypothesis import given, strategies as st

from topoloc.errors import CalibrationError
from topoloc.geometry.camera import MODELS, Camera

models = st.sampled_from(sorted(CAMERAS))
unit = st.floats(0.0, 1.0)
depths = st.floats(0.1, 100.0)


def grid(camera: Camera, num: int = 21) -> np.ndarray:
    """Return pixels all over the image, its corners included."""
    x, y = np.meshgrid(
        np.linspace(0.0, camera.width - 1.0, num), np.linspace(0.0, camera.height - 1.0, num)
    )
    return np.column_stack([x.ravel(), y.ravel()])


def test_every_model_has_a_camera_here():
    assert set(CAMERAS) == set(MODELS)


@given(models, unit, unit, depths)
def test_projection_undoes_unprojection(model, x, y, z):
    camera = CAMERAS[model]
    pixel = np.array([[x * (camera.width - 1), y * (camera.height - 1)]])
    normalized = camera.normalized_from_img(pixel)
    point_cam = np.append(normalized, [[1.0]], axis=1) * z
    np.testing.assert_allclose(camera.img_from_cam(point_cam), pixel, atol=1e-8)
    np.testing.assert_allclose(
        camera.normalized_from_img(camera.img_from_cam(point_cam)), normalized, rtol=1e-9, atol=1e-9
    )


@pytest.mark.parametrize("model", sorted(CAMERAS))
def test_projection_agrees_with_opencv(model):
    camera = CAMERAS[model]
    points_cam = (
        np.append(camera.normalized_from_img(grid(camera)), np.ones((21 * 21, 1)), axis=1) * 3.0
    )
    project = cv2.fisheye.projectPoints if camera.is_fisheye else cv2.projectPoints
    expected = project(
        points_cam[:, None], np.zeros(3), np.zeros(3), camera.matrix(), camera.distortion()
    )[0][:, 0]
    np.testing.assert_allclose(camera.img_from_cam(points_cam), expected, atol=1e-8)


@pytest.mark.parametrize("model", sorted(CAMERAS))
def test_jacobian_agrees_with_differences(model):
    camera = CAMERAS[model]
    pixels, step = grid(camera), 1e-4
    jacobian = camera.normalized_jacobian(camera.normalized_from_img(pixels))
    for axis in range(2):
        offset = step * np.eye(2)[axis]
        difference = (
            camera.normalized_from_img(pixels + offset)
            - camera.normalized_from_img(pixels - offset)
        ) / (2 * step)
        np.testing.assert_allclose(jacobian[:, :, axis], difference, rtol=1e-4, atol=1e-8)


@pytest.mark.parametrize("model", sorted(CAMERAS))
def test_rays_are_unit_vectors_towards_the_scene(model):
    rays = CAMERAS[model].rays_from_img(grid(CAMERAS[model]))
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0)
    assert np.all(rays[:, 2] > 0.0)


@given(models, st.integers(50, 2000), st.integers(50, 2000))
def test_rescaled_camera_sees_the_same_rays(model, width, height):
    camera = CAMERAS[model]
    rescaled = camera.rescaled(width, height)
    pixels = grid(camera, 5)
    scaled_pixels = (pixels + 0.5) * [width / camera.width, height / camera.height] - 0.5
    np.testing.assert_allclose(
        rescaled.normalized_from_img(scaled_pixels), camera.normalized_from_img(pixels), atol=1e-9
    )


def test_rescaling_keeps_the_model_if_both_scales_agree():
    assert CAMERAS["SIMPLE_RADIAL"].rescaled(320, 240).model == "SIMPLE_RADIAL"
    assert CAMERAS["SIMPLE_RADIAL"].rescaled(320, 241).model == "OPENCV"
    assert CAMERAS["OPENCV"].rescaled(752, 480) == CAMERAS["OPENCV"]


@pytest.mark.parametrize("model", sorted(CAMERAS))
def test_points_behind_the_camera_have_no_pixel(model):
    points_cam = np.array([[0.1, 0.1, -1.0], [0.0, 0.0, 0.0], [0.1, 0.1, 1.0], [np.nan, 0.0, 1.0]])
    pixels = CAMERAS[model].img_from_cam(points_cam)
    assert np.isfinite(pixels).all(axis=1).tolist() == [False, False, True, False]


def test_points_beyond_the_fold_of_the_distortion_have_no_pixel():
    camera = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, -0.3))
    fold = np.sqrt(1 / 0.9)  # at 1 - 3 * 0.3 r^2 = 0
    points_cam = np.array(
        [[0.98 * fold, 0.0, 1.0], [1.02 * fold, 0.0, 1.0], [2.0 * fold, 0.0, 1.0]]
    )
    assert np.isfinite(camera.img_from_cam(points_cam)).all(axis=1).tolist() == [True, False, False]
    farthest = 320.0 + 500.0 * fold * (1 - 0.3 * fold**2)
    pixels = np.array([[farthest - 1.0, 240.0], [farthest + 1.0, 240.0], [1e6, 240.0]])
    assert np.isfinite(camera.normalized_from_img(pixels)).all(axis=1).tolist() == [
        True,
        False,
        False,
    ]


def test_pixels_that_look_sideways_or_backwards_have_no_ray():
    pixels = np.array([[255.0, 257.0], [255.0 + 250.0, 257.0], [255.0, 257.0 + 255.0], [0.0, 0.0]])
    angles_deg = np.rad2deg(np.arccos(FISHEYE_195_DEG.rays_from_img(pixels)[:, 2]))
    assert angles_deg[0] < 0.1
    assert angles_deg[1] == pytest.approx(75.0, abs=2.0)
    assert np.isfinite(angles_deg).tolist() == [True, True, True, False]


@pytest.mark.parametrize("model", sorted(CAMERAS))
def test_no_points_give_no_points(model):
    camera = CAMERAS[model]
    assert camera.img_from_cam(np.zeros((0, 3))).shape == (0, 2)
    assert camera.normalized_from_img(np.zeros((0, 2))).shape == (0, 2)
    assert camera.rays_from_img(np.zeros((0, 2))).shape == (0, 3)


@pytest.mark.parametrize("model", sorted(CAMERAS))
def test_colmap_and_json_round_trips(model):
    camera = CAMERAS[model]
    name, width, height, params = camera.to_colmap()
    assert params[MODELS[name].index("cx")] == camera.cx + 0.5
    assert params[0] == camera.fx
    back = Camera.from_colmap(name, width, height, params)
    np.testing.assert_allclose(back.params, camera.params, rtol=1e-15)
    assert Camera.from_json(json.loads(json.dumps(camera.to_json()))) == camera


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (
            {"width": 640, "height": 480, "fx": 500, "fy": 500, "cx": 320},
            "missing required field `cy`",
        ),
        ({"model": "EYE", "width": 640, "height": 480}, "unknown camera model"),
        (
            {"width": 640, "height": 480, "fx": "wide", "fy": 500, "cx": 320, "cy": 240},
            "fx: Expected `float`, got `str`",
        ),
        (
            {"width": float("inf"), "height": 480, "fx": 500, "fy": 500, "cx": 320, "cy": 240},
            "width: a finite number",
        ),
        (
            {"width": 640, "height": 480, "fx": float("nan"), "fy": 500, "cx": 320, "cy": 240},
            "fx: a finite number",
        ),
        ({"width": 640, "height": 480, "fx": -500, "fy": 500, "cx": 320, "cy": 240}, "positive"),
        ({"width": 0, "height": 480, "fx": 500, "fy": 500, "cx": 320, "cy": 240}, "positive"),
    ],
)
def test_the_error_of_an_unusable_calibration_names_its_fault(data, message):
    with pytest.raises(CalibrationError, match=message):
        Camera.from_json(data)


def test_wrong_number_of_parameters_is_refused():
    with pytest.raises(CalibrationError, match="takes 4 parameters"):
        Camera("PINHOLE", 640, 480, (500.0, 320.0, 240.0))
