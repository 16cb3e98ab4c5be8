"""Test the reduction of query images, and the time at which their properties are computed."""

from __future__ import annotations

import numpy as np
import pytest

from topoloc.errors import QueryError
from topoloc.features.feature_types import FeatureConfig
from topoloc.geometry.camera import Camera, UncalibratedCamera
from topoloc.localization.query import Deadline, Query, check_image_size, reduce_image

MAP_FOCAL = 300.0
IMAGE = np.random.default_rng(0).integers(0, 256, (480, 640), dtype=np.uint8)
RGB = np.repeat(IMAGE[:, :, None], 3, axis=2)


def _camera(focal: float) -> Camera:
    return Camera.pinhole(640, 480, focal, focal, 310.0, 245.0)


@pytest.mark.parametrize("image", [IMAGE, RGB], ids=["grey", "RGB"])
def test_a_finer_picture_is_reduced_to_the_map_s_pixels_a_radian(image: np.ndarray):
    reduced, camera = reduce_image(image, _camera(600.0), MAP_FOCAL, 1.15, 1600)
    assert reduced.shape == (240, 320, *image.shape[2:])
    assert camera == _camera(600.0).rescaled(320, 240)
    np.testing.assert_allclose(
        reduced,
        image.reshape(240, 2, 320, 2, -1).mean(axis=(1, 3)).reshape(reduced.shape),
        atol=1.0,
    )


@pytest.mark.parametrize("focal", [100.0, 300.0, 340.0])
def test_a_picture_that_is_coarser_or_about_as_fine_stays_as_it_is(focal: float):
    reduced, camera = reduce_image(IMAGE, _camera(focal), MAP_FOCAL, 1.15, 1600)
    assert reduced is IMAGE
    assert camera == _camera(focal)


def test_the_longest_side_holds_for_coarse_pictures_too():
    reduced, camera = reduce_image(IMAGE, _camera(100.0), MAP_FOCAL, 1.15, 320)
    assert reduced.shape == (240, 320)
    assert camera == _camera(100.0).rescaled(320, 240)


def test_a_rough_camera_is_finer_as_far_as_its_whole_range_is():
    maybe, surely = (
        UncalibratedCamera(640, 480, 200.0, 1500.0),
        UncalibratedCamera(640, 480, 600.0, 1500.0),
    )
    assert reduce_image(IMAGE, maybe, MAP_FOCAL, 1.15, 1600) == (IMAGE, maybe)
    reduced, lens = reduce_image(IMAGE, surely, MAP_FOCAL, 1.15, 1600)
    assert reduced.shape == (240, 320)
    assert lens == UncalibratedCamera(320, 240, 300.0, 750.0)


def test_a_reduced_image_has_at_least_one_pixel():
    reduced, _ = reduce_image(
        IMAGE[:2, :40], Camera.pinhole(40, 2, 9000.0, 9000.0, 19.5, 0.5), MAP_FOCAL, 1.15, 1600
    )
    assert reduced.shape == (1, 1)


def test_a_camera_of_another_size_is_an_error():
    check_image_size(RGB, _camera(300.0))
    with pytest.raises(QueryError, match="the image is 640x480, its camera 480x640"):
        check_image_size(RGB, UncalibratedCamera.unknown(480, 640))


def test_features_are_extracted_at_first_use_and_once():
    query = Query(IMAGE, _camera(300.0), 1.0, FeatureConfig())
    assert "features" not in query.clock.times_ms()
    features = query.features
    assert len(features) > 100
    times_ms = query.clock.times_ms()
    assert times_ms["patch_normalization"] > 0.0
    assert query.features is features
    assert query.clock.times_ms()["features"] == times_ms["features"]


def test_a_query_is_late_from_its_deadline_on():
    assert not Query(IMAGE, _camera(300.0), 1.0, FeatureConfig()).deadline.is_past
    assert Deadline.from_limit(-1.0).is_past
    later = Deadline.from_limit(1e6)
    assert Deadline.from_limit(later) is later
    assert not later.is_past
    later.stop.set()
    assert later.is_past


def test_an_approximate_camera_is_replaced_by_its_likeliest():
    assert Query(IMAGE, _camera(300.0), 1.0, FeatureConfig()).camera == _camera(300.0)
    uncalibrated = UncalibratedCamera(640, 480, 200.0, 1500.0)
    assert 200.0 < Query(IMAGE, uncalibrated, 1.0, FeatureConfig()).camera.fx < 1500.0
