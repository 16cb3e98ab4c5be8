"""Localize the room with other cameras: other focal lengths and sizes, rolled, and uncalibrated."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, strategies as st

from built_room import built_room, unseen_views
from tiny_world import CAMERA, path_pose, render, room
from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.geometry.camera import Camera, UncalibratedCamera
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.localization.config import EvidenceConfig
from topoloc.localization.evidence import highest_probability
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.query import QueryImage
from topoloc.localization.result import Localization

INDICES = (2.5, 5.5, 8.5)


@pytest.fixture(scope="module")
def localizer(tiny_recording: Path) -> Localizer:
    return Localizer(built_room(tiny_recording))


def _is_right(result: object, truth: Rigid3, metres: float = 0.03) -> bool:
    return (
        isinstance(result, Localization)
        and translation_error(result.world_from_cam, truth) < metres
        and rotation_error(result.world_from_cam, truth) < np.deg2rad(1.0)
    )


@pytest.mark.parametrize("factor", [0.6, 1.0, 1.4, 1.8])
@pytest.mark.parametrize("size", [(320, 240), (480, 300)], ids=str)
def test_other_focal_lengths_and_sizes(factor: float, size: tuple[int, int], localizer: Localizer):
    width, height = size
    focal = CAMERA.fx * factor * height / CAMERA.height
    camera = Camera.pinhole(width, height, focal, focal, width / 2 - 3.0, height / 2 + 2.0)
    panels = room()
    results = [
        (localizer.localize(render(panels, path_pose(i), camera)[0], camera), path_pose(i))
        for i in INDICES
    ]
    assert sum(_is_right(result, truth) for result, truth in results) >= 2
    assert all(
        result.focal_length_px is None for result, _ in results if isinstance(result, Localization)
    )


@pytest.mark.parametrize("lens", ["calibrated", "focal length noted", "unknown"])
def test_a_camera_of_many_more_pixels_is_as_good_as_the_map_s_own(
    lens: str, localizer: Localizer, monkeypatch: pytest.MonkeyPatch
):
    """With three times the pixels per radian, map points are too small to be matched unless the
    image is reduced."""
    factor = 3
    camera = CAMERA.rescaled(factor * CAMERA.width, factor * CAMERA.height)
    known = {
        "calibrated": camera,
        "focal length noted": UncalibratedCamera.from_focal_guess(
            camera.width, camera.height, 1.05 * camera.fx
        ),
        "unknown": None,
    }
    panels = room()
    pictures = [(render(panels, path_pose(i), camera)[0], path_pose(i)) for i in INDICES]
    results = [(localizer.localize(picture, known[lens]), truth) for picture, truth in pictures]
    assert all(
        _is_right(result, truth, metres=0.03 if lens == "calibrated" else 0.15)
        for result, truth in results
    )
    monkeypatch.setattr(LocalizerConfig, "max_finer", 1e6)
    whole = Localizer(localizer.topomap, localizer.config)
    not_reduced = [whole.localize(picture, known[lens]) for picture, _ in pictures]
    assert all(
        one.num_inliers > 1.2 * other.num_inliers
        for (one, _), other in zip(results, not_reduced, strict=True)
    )
    focals = [
        result.focal_length_px
        for result, _ in results
        if isinstance(result, Localization) and result.focal_length_px is not None
    ]
    assert len(focals) == (0 if lens == "calibrated" else len(INDICES))
    assert focals == [pytest.approx(camera.fx, rel=0.05)] * len(focals)


def test_the_points_seen_by_a_finer_camera_are_in_its_own_pixels(localizer: Localizer):
    camera = CAMERA.rescaled(3 * CAMERA.width, 3 * CAMERA.height)
    truth = path_pose(5.5)
    result, named = localizer.localize_query(QueryImage(render(room(), truth, camera)[0], camera))
    assert isinstance(result, Localization)
    ((_, seen),) = named
    expected = camera.img_from_cam(truth.inverse().apply(seen.points_world))
    assert (
        np.median(np.linalg.norm(seen.points_img - expected, axis=1)) < 3.0
    )  # a pixel of the map's camera


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_rolled_cameras(degrees: int, localizer: Localizer):
    panels, turn = room(), Rigid3(exp_so3(np.array([0.0, 0.0, np.deg2rad(degrees)])), np.zeros(3))
    poses = [path_pose(i) @ turn for i in INDICES]
    assert all(
        _is_right(localizer.localize(render(panels, pose)[0], CAMERA), pose) for pose in poses
    )


def test_an_uncalibrated_camera(localizer: Localizer):
    results = [(localizer.localize(picture, None), truth) for picture, truth in unseen_views()]
    found = [(result, truth) for result, truth in results if isinstance(result, Localization)]
    assert len(found) >= 0.8 * len(results)
    assert all(_is_right(result, truth, metres=0.15) for result, truth in found)
    focals = [result.focal_length_px for result, _ in found if result.focal_length_px is not None]
    assert np.median(focals) == pytest.approx(CAMERA.fx, rel=0.02)


def test_a_focal_length_that_is_about_right_is_corrected(localizer: Localizer):
    uncalibrated = UncalibratedCamera.from_focal_guess(
        CAMERA.width, CAMERA.height, 1.08 * CAMERA.fx
    )
    focals = []
    for picture, _ in unseen_views():
        result = localizer.localize(picture, uncalibrated)
        assert isinstance(result, Localization)
        focals.append(result.focal_length_px)
    assert np.median(focals) == pytest.approx(CAMERA.fx, rel=0.02)


def test_an_unknown_focal_length_makes_the_pose_less_certain(localizer: Localizer):
    picture, _ = unseen_views()[2]
    known, unknown = localizer.localize(picture, CAMERA), localizer.localize(picture, None)
    assert isinstance(known, Localization)
    assert isinstance(unknown, Localization)
    assert np.trace(unknown.camera_covariance[:3, :3]) > np.trace(known.camera_covariance[:3, :3])


def test_noise_is_not_localized_with_a_free_focal_length(localizer: Localizer):
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 256, (240, 320), dtype=np.uint8) for _ in range(5)]
    pictures += [picture for picture, _ in unseen_views(seed=1, step=4.0)]
    assert not any(
        isinstance(localizer.localize(picture, None), Localization) for picture in pictures
    )


@pytest.mark.parametrize(("left", "top"), [(0.0, 0.0), (0.1, 0.0), (0.25, 0.0), (0.0, 0.25)])
def test_a_cropped_picture_without_calibration_is_localized_or_refused(
    left: float, top: float, localizer: Localizer
):
    camera, panels, num_right = CAMERA.rescaled(640, 480), room(), 0
    for index in (2.5, 4.5, 5.5, 7.5, 8.5):
        picture, truth = render(panels, path_pose(index), camera)[0], path_pose(index)
        result = localizer.localize(picture[round(480 * top) :, round(640 * left) :], None)
        if isinstance(result, Localization):
            is_right = _is_right(result, truth, metres=0.25)
            num_right += is_right
            assert is_right or result.probability < 0.5
            assert result.provenance.camera is not None
            assert result.provenance.camera.width == 640 - round(640 * left)
            if result.probability > 0.95:
                assert result.position_sigma_m < 0.25
                assert result.rotation_sigma_deg < 2.0
    assert num_right >= 4


@given(st.floats(1e-4, 3.0), st.floats(1e-4, 20.0))
def test_a_probability_above_95_percent_has_sigmas_of_half_the_tolerance(
    metres: float, degrees: float
):
    variances = np.repeat([metres**2 / 3.0, np.deg2rad(degrees) ** 2 / 3.0], 3)
    highest = highest_probability(np.diag(variances), 2.0, EvidenceConfig())
    sigmas = 1.9599  # of a normal distribution with 5 % beyond
    assert (highest > 0.95) <= (sigmas * metres <= 0.25 and sigmas * degrees <= 2.0)
    assert highest > 0.99 or metres > 0.09 or degrees > 0.75, "it must not refuse everything"


def test_an_upper_bound_of_the_error_refuses_no_pose():
    config = EvidenceConfig()
    variances = np.repeat([1.0, np.deg2rad(20.0) ** 2], 3)
    assert highest_probability(np.diag(variances), 2.0, config) == config.min_probability


@given(st.floats(1e-3, 1.0), st.floats(0.1, 100.0))
def test_without_scale_the_highest_probability_has_no_unit(share: float, unit: float):
    """The same pose and points in another unit."""
    config = EvidenceConfig(is_relative=True)
    rotation = np.repeat(np.deg2rad(0.1) ** 2 / 3.0, 3)

    def of_unit(unit: float) -> float:
        position = np.repeat((share * unit) ** 2 / 3.0, 3)
        covariance = np.diag(np.concatenate([position, rotation]))
        return highest_probability(covariance, 4.0 * unit, config)

    assert of_unit(unit) == pytest.approx(of_unit(1.0))
    # 1.96 sigmas of the tolerance, 5 % of the depth
    assert (of_unit(1.0) > 0.95) == (share < 0.2 / 1.96) or abs(share - 0.2 / 1.96) < 1e-4


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_an_image_whose_rows_were_scaled_after_its_calibration(factor: float, localizer: Localizer):
    """The calibration is that of the width, as of clients that scale it by one side."""
    camera, panels, num_right = CAMERA.rescaled(640, 480), room(), 0
    height = round(480 * factor)
    stated = Camera.pinhole(640, height, camera.fx, camera.fx, camera.cx, (height - 1) / 2)
    for index in (2.5, 3.5, 4.5, 5.5, 7.5, 8.5):
        picture, truth = render(panels, path_pose(index), camera)[0], path_pose(index)
        result = localizer.localize(cv2.resize(picture, (640, height)), stated)
        is_right = _is_right(result, truth, metres=0.1)
        assert is_right or not isinstance(result, Localization) or result.probability < 0.6
        num_right += is_right
        doubt = getattr(result, "calibration_doubt", None)
        if doubt is not None and "height" in doubt.of:
            assert "scaling in one direction" in str(doubt)
            assert doubt.focal_length_px == pytest.approx(factor * camera.fx, rel=0.03)
            assert result.provenance.camera is not None
            assert result.provenance.camera.fy == pytest.approx(doubt.focal_length_px)
    assert num_right >= 4
