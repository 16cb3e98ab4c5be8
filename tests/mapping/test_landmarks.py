"""Test points refined by observations of other images: errors shrink, covariances stay right,
outliers are found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import ray_covariances
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.mapping.landmarks import Observations, observe_points, refine_points
from topoloc.points.metric_points import keypoint_sigmas

CAMERA = Camera.pinhole(640, 480, 500.0, 500.0, 320.0, 240.0)
SIGMA_PX = 0.8


@dataclass
class Scene:
    """Hold true points, their measurement by one stereo pair, and eight views of them from up
    to a metre away."""

    truth: np.ndarray
    measured: np.ndarray
    covariances: np.ndarray
    observations: list[Observations]


def scene(num_points: int = 400, seed: int = 0) -> Scene:
    rng = np.random.default_rng(seed)
    z = rng.uniform(2.0, 12.0, num_points)
    truth = np.column_stack([rng.uniform(-0.5, 0.5, (num_points, 2)) * z[:, None], z])
    sigma_z = z**2 / (500.0 * 0.12) * 0.3
    covariances = ray_covariances(truth, sigma_z, CAMERA, np.full(num_points, SIGMA_PX))
    measured = truth + np.einsum(
        "nij,nj->ni", np.linalg.cholesky(covariances), rng.standard_normal((num_points, 3))
    )
    observations = [
        view(
            truth,
            Rigid3(exp_so3(rng.normal(0, 0.05, 3)), rng.uniform(-1, 1, 3) * [1, 0.3, 0.5]),
            rng,
        )
        for _ in range(8)
    ]
    return Scene(truth, measured, covariances, observations)


def view(points: np.ndarray, cam_from_node: Rigid3, rng: np.random.Generator) -> Observations:
    """Return noisy observations of seven of ten points."""
    rows = np.flatnonzero(rng.random(len(points)) < 0.7)
    seen = cam_from_node.apply(points[rows])
    normalized = seen[:, :2] / seen[:, 2:] + rng.normal(0, SIGMA_PX / 500.0, (len(rows), 2))
    return Observations(rows, normalized, np.full(len(rows), SIGMA_PX / 500.0), cam_from_node)


def test_errors_shrink_and_covariances_stay_honest():
    s = scene()
    refined = refine_points(s.measured, s.covariances, s.observations)
    before, after = (np.linalg.norm(p - s.truth, axis=1) for p in (s.measured, refined.points_cam))
    assert np.median(after) < 0.3 * np.median(before)
    error = refined.points_cam - s.truth
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(refined.covariances), error)
    # an exact covariance gives 3 on average, and the robust weights make it slightly larger
    assert 1.5 < nees.mean() < 3.6
    assert refined.is_consistent.mean() > 0.99
    assert refined.num_observations.sum() == sum(len(seen.rows) for seen in s.observations)


def test_covariance_never_grows():
    s = scene()
    refined = refine_points(s.measured, s.covariances, s.observations)
    assert (np.linalg.eigvalsh(s.covariances - refined.covariances) > -1e-9).all()


def test_a_point_that_moved_is_dropped_and_its_neighbours_are_not():
    s = scene()
    moved = np.arange(20)
    s.truth[moved, 0] += 1.0
    rng = np.random.default_rng(5)
    observations = [view(s.truth, seen.cam_from_node, rng) for seen in s.observations]
    refined = refine_points(s.measured, s.covariances, observations)
    assert not refined.is_consistent[moved].any()
    assert refined.is_consistent[20:].mean() > 0.99


def test_one_wrong_observation_does_not_pull_a_point_away():
    s = scene()
    s.observations[3].normalized[:, 0] += 30.0 / 500.0
    refined = refine_points(s.measured, s.covariances, s.observations)
    clean = refine_points(s.measured, s.covariances, scene().observations)
    assert np.median(np.linalg.norm(refined.points_cam - s.truth, axis=1)) < 1.5 * np.median(
        np.linalg.norm(clean.points_cam - s.truth, axis=1)
    )


def test_without_observations_everything_stays_as_measured():
    s = scene(10)
    refined = refine_points(s.measured, s.covariances, [])
    np.testing.assert_allclose(refined.points_cam, s.measured)
    np.testing.assert_allclose(refined.covariances, s.covariances, rtol=1e-6)
    assert refined.is_consistent.all()
    assert refined.num_observations.tolist() == [0] * 10


def features_at(points_img: np.ndarray, seed: int = 3) -> Features:
    """Return features with a different descriptor per point. Equal seeds give equal descriptors."""
    num = len(points_img)
    descriptors = np.random.default_rng(seed).standard_normal((num, 64)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    same = np.full(num, 15.0, np.float32)
    return Features(points_img.astype(np.float32), same, 0 * same, same, descriptors)


def observed(offset_px: np.ndarray) -> tuple[Observations, np.ndarray]:
    """Return another image's observations of the scene's points, with this offset of
    the key points."""
    s, cam_from_node = (
        scene(60),
        Rigid3(exp_so3(np.array([0.0, 0.1, 0.0])), np.array([0.3, 0.0, 0.1])),
    )
    points_img = CAMERA.img_from_cam(cam_from_node.apply(s.truth))
    seen = observe_points(
        features_at(points_img),
        s.truth,
        s.covariances,
        features_at(points_img + offset_px),
        CAMERA,
        cam_from_node,
    )
    return seen, points_img


def test_points_are_matched_by_descriptor_at_their_projections():
    seen, points_img = observed(np.zeros((60, 2)))
    assert sorted(seen.rows.tolist()) == list(range(60))
    np.testing.assert_allclose(
        seen.normalized, CAMERA.normalized_from_img(points_img)[seen.rows], atol=1e-6
    )
    sigmas_px = keypoint_sigmas(features_at(points_img))
    assert seen.sigmas == pytest.approx(np.hypot(sigmas_px, 0.7) / 500.0)


def test_a_match_that_geometry_forbids_is_no_observation():
    offset = np.zeros((60, 2))
    offset[:10, 1] = 40.0  # across the direction in which depth is uncertain
    seen, _ = observed(offset)
    assert sorted(seen.rows.tolist()) == list(range(10, 60))


def test_points_behind_the_other_camera_are_not_observed():
    s = scene(30)
    behind = Rigid3(exp_so3(np.array([0.0, np.pi, 0.0])), np.zeros(3))
    features = features_at(CAMERA.img_from_cam(s.truth))
    seen = observe_points(features, s.truth, s.covariances, features, CAMERA, behind)
    assert len(seen.rows) == 0
