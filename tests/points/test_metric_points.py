"""Test 3-D positions of features, from stereo and from depth, against the truth of a
rendered room."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import tiny_world
from topoloc.errors import RecordingError
from topoloc.features.extraction import FeatureConfig, extract_features
from topoloc.features.features import Features
from topoloc.geometry.rig import StereoRig
from topoloc.geometry.rigid import Rigid3
from topoloc.points.metric_points import (
    MetricPoints,
    keypoint_sigmas,
    locate_points,
    select_certain_points,
)
from topoloc.recordings.frame_preparation import PreparedFrame


@pytest.fixture(scope="module")
def room_view() -> tuple[PreparedFrame, np.ndarray]:
    """Return left and right image of the room, and the exact depth."""
    panels, pose = tiny_world.room(), tiny_world.path_pose(4)
    (left, depth), (right, _) = (
        tiny_world.render(panels, p, noise_seed=k)
        for k, p in enumerate((pose, tiny_world.right_pose(pose)))
    )
    rig = StereoRig.rectified(tiny_world.CAMERA, tiny_world.BASELINE)
    return PreparedFrame(left, left, tiny_world.CAMERA, Rigid3.identity(), right, rig), depth


def depth_view(view: PreparedFrame, depth: np.ndarray) -> PreparedFrame:
    return replace(view, right_grey=None, rig=None, depth=depth.astype(np.float32))


def true_depths(features: Features, depth: np.ndarray) -> np.ndarray:
    columns, rows = np.rint(features.points_img).astype(int).T
    return depth[rows, columns]


def depth_errors_in_sigmas(located: MetricPoints, truth: np.ndarray) -> np.ndarray:
    rows = located.valid & np.isfinite(truth)
    return (located.points_cam[rows, 2] - truth[rows]) / np.sqrt(located.covariances[rows, 2, 2])


def test_stereo_points_lie_at_their_pixels(room_view: tuple[PreparedFrame, np.ndarray]):
    view, depth = room_view
    features = extract_features(view.grey, FeatureConfig())
    located = locate_points(features, view)
    assert located.valid.mean() > 0.7
    errors = depth_errors_in_sigmas(located, true_depths(features, depth))
    assert abs(np.median(errors)) < 0.2
    assert (np.abs(errors) > 4).mean() < 0.03  # beside the edges of the boards
    reprojected = view.camera.img_from_cam(located.points_cam[located.valid])
    np.testing.assert_allclose(reprojected, features.points_img[located.valid], atol=1e-3)


def test_depth_points_lie_at_their_pixels(room_view: tuple[PreparedFrame, np.ndarray]):
    view, depth = room_view
    features = extract_features(view.grey, FeatureConfig())
    located = locate_points(features, depth_view(view, depth))
    errors = depth_errors_in_sigmas(located, true_depths(features, depth))
    assert located.valid.mean() > 0.7
    assert np.quantile(np.abs(errors), 0.95) < 2.0


def test_covariances_are_positive_definite_and_largest_along_the_ray(
    room_view: tuple[PreparedFrame, np.ndarray],
):
    view, _ = room_view
    located = locate_points(extract_features(view.grey, FeatureConfig()), view)
    values, vectors = np.linalg.eigh(located.covariances[located.valid])
    assert (values > 0).all()
    rays = located.points_cam[located.valid]
    along = np.abs(
        np.einsum("ni,ni->n", vectors[:, :, 2], rays / np.linalg.norm(rays, axis=1, keepdims=True))
    )
    assert np.median(along) > 0.99


def test_uncertain_depth_is_dropped(room_view: tuple[PreparedFrame, np.ndarray]):
    view, _ = room_view
    assert view.rig is not None
    features = extract_features(view.grey, FeatureConfig())
    loose = locate_points(features, view)
    sigma_z = np.sqrt(loose.covariances[:, 2, 2])
    strict = select_certain_points(
        loose.points_cam, sigma_z, view.camera, keypoint_sigmas(features), 0.015
    )
    assert 0 < strict.valid.sum() < loose.valid.sum()
    assert (
        np.sqrt(strict.covariances[strict.valid, 2, 2]).max()
        < 0.015 * strict.points_cam[strict.valid, 2].max()
    )
    assert np.isnan(strict.points_cam[~strict.valid]).all()


def points_at(points_img: list[tuple[float, float]]) -> Features:
    n = len(points_img)
    same = np.full(n, 20.0, np.float32)
    return Features(
        np.array(points_img, np.float32).reshape(n, 2),
        same,
        0 * same,
        same,
        np.ones((n, 64), np.float32),
    )


def test_depth_beside_a_jump_or_unknown_is_dropped(room_view: tuple[PreparedFrame, np.ndarray]):
    depth = np.full((240, 320), 2.0)
    depth[:, 160:] = 3.0
    depth[100:140, 40:80] = np.nan
    features = points_at(
        [
            (100.2, 50.7),
            (158.6, 50.0),
            (161.0, 50.0),
            (200.0, 50.0),
            (60.0, 120.0),
            (0.0, 0.0),
            (319.0, 239.0),
        ]
    )
    located = locate_points(features, depth_view(room_view[0], depth))
    assert located.valid.tolist() == [True, False, False, True, False, True, True]
    assert located.points_cam[0, 2] == pytest.approx(2.0)


def test_coarse_depth_is_exact_on_planes_and_uncertain_at_smeared_edges(
    room_view: tuple[PreparedFrame, np.ndarray],
):
    camera = room_view[0].camera
    coarse = camera.rescaled(camera.width // 8, camera.height // 8)
    columns = np.arange(coarse.width)
    slanted = 1.0 / (0.4 - 0.25 * (columns - coarse.cx) / coarse.fx)
    jump = np.interp(columns, [18, 22], [2.0, 3.0])
    for depth, is_plane in ((slanted, True), (jump, False)):
        depths = np.tile(depth, (coarse.height, 1))
        x = np.arange(8.0, camera.width - 8.0, 5.0)
        located = locate_points(
            points_at([(float(one), 100.0) for one in x]), depth_view(room_view[0], depths)
        )
        near_edge, sigma = np.abs(x - 163.5) < 20, np.sqrt(located.covariances[:, 2, 2])
        z = located.points_cam[:, 2]
        if is_plane:
            truth = 1.0 / (0.4 - 0.25 * (x - camera.cx) / camera.fx)
            np.testing.assert_allclose(z, truth, rtol=1e-3)
            assert (np.abs(sigma / z - 0.01) < 0.005).all()
        else:
            truth = np.where(x < 163.5, 2.0, 3.0)
            assert (np.abs(z - truth)[near_edge] > 0.1).any()
            assert (np.abs(z - truth) < 3.0 * sigma).all()


def test_no_features_give_no_points(room_view: tuple[PreparedFrame, np.ndarray]):
    view, depth = room_view
    for one in (view, depth_view(view, depth)):
        assert locate_points(Features.empty(64), one).points_cam.shape == (0, 3)


def test_a_single_picture_has_no_points(room_view: tuple[PreparedFrame, np.ndarray]):
    with pytest.raises(RecordingError, match="a stereo pair or a depth image"):
        locate_points(Features.empty(64), replace(room_view[0], right_grey=None, rig=None))


def test_larger_key_points_are_less_certain():
    features = points_at([(0, 0), (1, 1)])
    features.sizes_px[:] = 9.0, 90.0
    small, large = keypoint_sigmas(features)
    assert large == pytest.approx(0.4 * 12.0)
    assert small == pytest.approx(max(0.3, 0.4 * 1.2))
