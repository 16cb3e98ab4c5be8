"""Test the calibration estimate from many images of one camera: more exact than one image, and not
overconfident."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from topoloc.geometry.calibration_check import (
    MIN_IMAGES,
    MIN_PLACES,
    IntrinsicsDeviation,
    check_calibration_consistency,
)
from topoloc.geometry.camera import Camera

CAMERA = Camera.pinhole(640, 480, 400.0, 400.0, 319.5, 239.5)
SIGMAS = np.array([0.02, 0.015, 0.015])  # one image: 5 % of the focal length are 2.5 sigmas


def pictures(
    deviation: tuple[float, float, float],
    num: int,
    rng: np.random.Generator,
    num_places: int | None = None,
) -> list[IntrinsicsDeviation]:
    """Return deviations, each with noise as its covariance states. Images of one place
    share the noise."""
    seen = []
    places = np.arange(num) % (num_places or num)
    noise = rng.normal(size=(num, 3))
    for place in places:
        spread = SIGMAS * rng.uniform(0.5, 2.0)
        shared = noise[place] if num_places else rng.normal(size=3)
        seen.append(
            IntrinsicsDeviation(
                np.array(deviation) + spread * shared, np.diag(spread**2), int(place)
            )
        )
    return seen


@pytest.mark.parametrize(
    ("deviation", "has_focal_mismatch", "has_principal_point_mismatch"),
    [
        ((0.05, 0.0, 0.0), True, False),
        ((-0.05, 0.0, 0.0), True, False),
        ((0.0, 0.08, 0.0), False, True),
        ((0.0, 0.0, -0.08), False, True),
    ],
)
def test_images_together_name_errors_that_one_cannot(
    deviation: tuple[float, float, float],
    has_focal_mismatch: bool,
    has_principal_point_mismatch: bool,
):
    rng = np.random.default_rng(0)
    for _ in range(20):
        verdict = check_calibration_consistency(pictures(deviation, 40, rng), CAMERA)
        assert verdict is not None
        assert (verdict.has_focal_mismatch, verdict.has_principal_point_mismatch) == (
            has_focal_mismatch,
            has_principal_point_mismatch,
        )
        assert verdict.focal_length_px == pytest.approx(
            400.0 * np.exp(deviation[0]), abs=4.0 * verdict.focal_sigma_px
        )
        centre = np.array([319.5, 239.5]) + 400.0 * np.array(deviation[1:])
        assert (
            np.abs(verdict.principal_point_px - centre) < 4.0 * verdict.principal_point_sigma_px
        ).all()
        assert "the pictures say" in str(verdict)


def test_right_calibrations_pass_and_sigmas_are_right():
    rng = np.random.default_rng(1)
    normed = []
    for _ in range(200):
        verdict = check_calibration_consistency(
            pictures((0.0, 0.0, 0.0), int(rng.integers(MIN_IMAGES, 60)), rng), CAMERA
        )
        assert verdict is not None
        assert not verdict.is_contradicted
        assert "agree" in str(verdict)
        normed.append((verdict.focal_length_px - 400.0) / verdict.focal_sigma_px)
    assert 0.7 < np.std(normed) < 1.3


def test_a_few_wrong_pictures_do_not_count():
    rng = np.random.default_rng(2)
    for _ in range(20):
        seen = pictures((0.0, 0.0, 0.0), 30, rng)
        for index in range(6):  # sure of something else, each of its own
            seen[index] = IntrinsicsDeviation(
                rng.normal(0.0, 0.3, 3), np.diag((0.2 * SIGMAS) ** 2), index
            )
        verdict = check_calibration_consistency(seen, CAMERA)
        assert verdict is not None
        assert not verdict.is_contradicted


def test_pictures_of_one_place_count_as_one():
    rng = np.random.default_rng(3)
    many, few = (
        check_calibration_consistency(pictures((0.0, 0.0, 0.0), 60, rng, places), CAMERA)
        for places in (60, 6)
    )
    assert many is not None
    assert few is not None
    assert few.focal_sigma_px > 2.0 * many.focal_sigma_px


def test_a_scatter_beyond_their_noise_is_seen():
    rng = np.random.default_rng(4)
    sure = [
        IntrinsicsDeviation(rng.normal(0.0, 0.05, 3), np.diag((0.001 * np.ones(3)) ** 2), place)
        for place in range(20)
    ]
    verdict = check_calibration_consistency(sure, CAMERA)
    assert verdict is not None
    assert verdict.focal_sigma_px > 400.0 * 0.05 / np.sqrt(20) / 2.0
    assert not verdict.is_contradicted


def test_few_images_give_no_result():
    rng = np.random.default_rng(5)
    assert (
        check_calibration_consistency(pictures((0.2, 0.0, 0.0), MIN_IMAGES - 1, rng), CAMERA)
        is None
    )
    assert (
        check_calibration_consistency(pictures((0.2, 0.0, 0.0), 50, rng, MIN_PLACES - 1), CAMERA)
        is None
    )
    assert (
        check_calibration_consistency(pictures((0.2, 0.0, 0.0), 50, rng, MIN_PLACES), CAMERA)
        is not None
    )


def test_images_with_equal_deviations():
    verdict = check_calibration_consistency(
        [
            IntrinsicsDeviation(np.zeros(3), np.diag(SIGMAS**2), place)
            for place in range(MIN_IMAGES)
        ],
        CAMERA,
    )
    assert verdict is not None
    assert not verdict.is_contradicted
    assert verdict.to_json()["principal_point_px"] == pytest.approx([319.5, 239.5])


@pytest.mark.parametrize(("num_distorted", "is_named"), [(0, False), (5, False), (9, True)])
def test_a_third_of_the_images_must_show_a_lens(num_distorted: int, is_named: bool):
    seen = pictures((0.08, 0.0, 0.0), 20, np.random.default_rng(5))
    seen = [replace(one, is_distorted=k < num_distorted) for k, one in enumerate(seen)]
    verdict = check_calibration_consistency(seen, CAMERA)
    assert verdict is not None
    assert verdict.is_contradicted
    assert verdict.has_distortion_mismatch == is_named
    assert verdict.has_focal_mismatch
    assert ("their lens distorts more" in str(verdict)) == is_named
