"""Test the parts of a pose error: independent per image, or lasting."""

from __future__ import annotations

import numpy as np
import pytest

from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.localization.result import Localization
from topoloc.tracking.tracker_state import compute_correlated_change, compute_pose_errors

WORLD_FROM_CAM = Rigid3(exp_so3(np.array([0.3, -1.0, 0.2])), np.array([40.0, -7.0, 2.0]))
IN_CAMERA = np.diag([1e-4, 2e-4, 4e-4, 1e-5, 2e-5, 3e-5])


def found(noise_share: float) -> Localization:
    adjoint = WORLD_FROM_CAM.adjoint()
    return Localization(
        WORLD_FROM_CAM,
        adjoint @ IN_CAMERA @ adjoint.T,
        0.9,
        0,
        [],
        100,
        80,
        noise_share=noise_share,
    )


@pytest.mark.parametrize("noise_share", [1.0, 0.25, 0.002])
def test_the_parts_make_the_whole(noise_share: float):
    errors = compute_pose_errors(found(noise_share), 3.0, 0.0)
    np.testing.assert_allclose(errors.noise, noise_share * IN_CAMERA, atol=1e-12)
    np.testing.assert_allclose(errors.total, IN_CAMERA, atol=1e-12)


def test_noise_has_a_floor_that_grows_with_the_depth():
    near, far = (
        np.sqrt(np.diag(compute_pose_errors(found(1e-9), depth, 0.002).noise))
        for depth in (2.0, 20.0)
    )
    np.testing.assert_allclose(near, np.repeat([0.004, 0.002], 3), rtol=1e-2)
    np.testing.assert_allclose(far, np.repeat([0.04, 0.002], 3), rtol=1e-2)


def test_lasting_errors_change_with_the_view():
    errors = compute_pose_errors(found(0.1), 4.0, 0.001)
    still, step, far = (Rigid3(np.eye(3), np.array([way, 0.0, 0.0])) for way in (0.0, 0.04, 400.0))
    np.testing.assert_allclose(compute_correlated_change(errors, still), 0.0, atol=1e-15)
    np.testing.assert_allclose(
        compute_correlated_change(errors, step), 0.01 * errors.correlated, rtol=1e-2
    )
    np.testing.assert_allclose(
        compute_correlated_change(errors, far), 2.0 * errors.correlated, rtol=1e-6
    )
    turned = Rigid3(exp_so3(np.array([0.0, 0.01, 0.0])), np.zeros(3))
    np.testing.assert_allclose(
        compute_correlated_change(errors, turned),
        compute_correlated_change(errors, step),
        rtol=1e-6,
    )
