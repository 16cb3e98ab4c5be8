"""Test the camera parameters that several images estimate together."""

from __future__ import annotations

import numpy as np

from topoloc.geometry.absolute_pose_focal import camera_prior
from topoloc.geometry.camera import Camera, UncalibratedCamera
from topoloc.geometry.joint_camera.camera_hypotheses import CameraLikelihood
from topoloc.tracking.shared_cameras import SharedCamera, combine_likelihoods

PRIOR = camera_prior(UncalibratedCamera.unknown(640, 480), 640.0)
SIGMAS = np.array([0.02, 0.01, 0.01, *[0.02] * 5, *[0.01] * 3])
TRUE = np.array([-0.2, 0.08, *[0.0] * 9])  # cropped at one side


def _seen(parameters: np.ndarray) -> CameraLikelihood:
    information = np.diag(SIGMAS**-2)
    return CameraLikelihood(information, information @ parameters)


def _images(num: int, seed: int) -> list[CameraLikelihood]:
    noise = np.random.default_rng(seed).normal(size=(num, 11)) * SIGMAS
    return [_seen(TRUE + one) for one in noise]


def _estimate(images: list[CameraLikelihood], num_places: int) -> tuple[np.ndarray, np.ndarray]:
    weighed = PRIOR.weigh(combine_likelihoods(images, PRIOR, num_places))
    chosen = max(weighed, key=lambda one: weighed[one][0])
    assert chosen.off_centre
    assert chosen.lens == "none"
    return weighed[chosen][1], np.sqrt(np.diag(weighed[chosen][2]))


def test_images_together_have_smaller_errors_and_sigmas():
    errors = []
    for seed in range(20):
        estimate, sigmas = _estimate(_images(16, seed), 16)
        errors.append((estimate - TRUE)[:3] / sigmas[:3])
        assert sigmas[0] < 0.4 * SIGMAS[0]
    assert 0.6 < np.sqrt(np.mean(np.square(errors))) < 1.3


def test_images_of_another_camera_hardly_count():
    zoomed = _seen(TRUE + 0.4 * np.eye(11)[0])
    estimate, sigmas = _estimate([*_images(10, 1), zoomed, zoomed], 12)
    assert abs(estimate[0] - TRUE[0]) < 3.0 * sigmas[0]


def test_images_of_one_place_count_once():
    _, at_many = _estimate(_images(16, 2), 16)
    _, at_one = _estimate(_images(16, 2), 4)
    assert at_one[0] > 1.5 * at_many[0]


def test_a_shared_camera_prints_its_distortion():
    camera = Camera("RADIAL", 640, 480, (500.0, 319.5, 239.5, -0.3, 0.08))
    shared = SharedCamera(camera, np.diag(np.arange(1.0, 12.0) ** 2 * 1e-4), 12)
    assert "k1 = -0.300 +- 0.040, k2 = 0.080 +- 0.080, from 12 images" in str(shared)
