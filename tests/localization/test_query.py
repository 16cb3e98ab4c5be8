"""Which queries are reduced before they are looked at, and how far."""

from __future__ import annotations

import numpy as np
import pytest
from topoloc.localization.query_size import reduced_query

from topoloc.geometry.camera import Camera
from topoloc.geometry.rough_camera import RoughCamera

MAP_FOCAL = 300.0
IMAGE = np.random.default_rng(0).integers(0, 256, (480, 640), dtype=np.uint8)
RGB = np.repeat(IMAGE[:, :, None], 3, axis=2)


def _camera(focal: float) -> Camera:
    return Camera.pinhole(640, 480, focal, focal, 310.0, 245.0)


@pytest.mark.parametrize("image", [IMAGE, RGB], ids=["grey", "RGB"])
def test_a_finer_picture_is_reduced_to_the_map_s_pixels_a_radian(image: np.ndarray):
    reduced, camera = reduced_query(image, _camera(600.0), MAP_FOCAL, 1.15, 1600)
    assert reduced.shape == (240, 320, *image.shape[2:])
    assert camera == _camera(600.0).rescaled(320, 240)
    np.testing.assert_allclose(reduced, image.reshape(240, 2, 320, 2, -1).mean(axis=(1, 3)).reshape(reduced.shape), atol=1.0)


@pytest.mark.parametrize("focal", [100.0, 300.0, 340.0])
def test_a_picture_that_is_coarser_or_about_as_fine_stays_as_it_is(focal: float):
    reduced, camera = reduced_query(IMAGE, _camera(focal), MAP_FOCAL, 1.15, 1600)
    assert reduced is IMAGE
    assert camera == _camera(focal)


def test_the_longest_side_holds_for_coarse_pictures_too():
    reduced, camera = reduced_query(IMAGE, _camera(100.0), MAP_FOCAL, 1.15, 320)
    assert reduced.shape == (240, 320)
    assert camera == _camera(100.0).rescaled(320, 240)


def test_a_rough_camera_is_finer_as_far_as_its_whole_range_is():
    maybe, surely = RoughCamera(640, 480, 200.0, 1500.0), RoughCamera(640, 480, 600.0, 1500.0)
    assert reduced_query(IMAGE, maybe, MAP_FOCAL, 1.15, 1600) == (IMAGE, maybe)
    reduced, lens = reduced_query(IMAGE, surely, MAP_FOCAL, 1.15, 1600)
    assert reduced.shape == (240, 320)
    assert lens == RoughCamera(320, 240, 300.0, 750.0)


def test_a_picture_of_hardly_a_pixel_keeps_one():
    reduced, _ = reduced_query(IMAGE[:2, :40], Camera.pinhole(40, 2, 9000.0, 9000.0, 19.5, 0.5), MAP_FOCAL, 1.15, 1600)
    assert reduced.shape == (1, 1)
