"""Test 3-D positions of an image's features from other images with known poses: made points with
known noise, and the rendered room."""

from __future__ import annotations

import numpy as np

import tiny_world
from topoloc.features.extraction import FeatureConfig, extract_features
from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.points.metric_points import MetricPoints, keypoint_sigmas
from topoloc.points.motion_triangulation import (
    SourceImage,
    select_source_images,
    triangulate_from_motion,
)

LENS = Camera("OPENCV", 640, 480, (500.0, 500.0, 319.5, 239.5, -0.1, 0.02, 0.0, 0.0))
SIGMA_PX = 0.5
POSES = [
    Rigid3(exp_so3(np.array([0.0, 0.02 * k, 0.0])), np.array([0.2 * k, 0.03 * k, 0.05 * k]))
    for k in (1, 2, 3, 4)
]


def _features(points_img: np.ndarray, descriptors: np.ndarray) -> Features:
    ones = np.ones(len(points_img), np.float32)
    return Features(points_img.astype(np.float32), ones, ones, ones, descriptors)


def _made(num: int = 400, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return points in front of a camera at the origin (metres), and a descriptor of each."""
    rng = np.random.default_rng(seed)
    points = np.column_stack(
        [rng.uniform(-1.0, 1.6, num), rng.uniform(-0.8, 0.8, num), rng.uniform(2.5, 6.0, num)]
    )
    descriptors = rng.normal(size=(num, 64)).astype(np.float32)
    return points, descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)


def _located(
    points: np.ndarray,
    descriptors: np.ndarray,
    order: list[np.ndarray] | None = None,
    poses: list[Rigid3] = POSES,
) -> MetricPoints:
    """Return the triangulated points. `order` assigns descriptors to points in each other image."""
    rng = np.random.default_rng(7)
    sigmas = np.full(len(points), SIGMA_PX)
    own = _features(
        LENS.img_from_cam(points) + SIGMA_PX * rng.normal(size=(len(points), 2)), descriptors
    )
    others = []
    for k, world_from_other in enumerate(poses):
        other_from_cam = world_from_other.inverse()
        seen = LENS.img_from_cam(other_from_cam.apply(points)) + SIGMA_PX * rng.normal(
            size=(len(points), 2)
        )
        shown = descriptors if order is None else descriptors[order[k]]
        others.append(SourceImage(_features(seen, shown), sigmas, LENS, other_from_cam))
    return triangulate_from_motion(own, sigmas, LENS, others, pose_sigma_px=0.0)


def test_errors_match_the_covariances():
    points, descriptors = _made()
    located = _located(points, descriptors)
    assert located.valid.mean() > 0.95
    errors = (located.points_cam - points)[located.valid]
    squares = np.einsum(
        "ni,nij,nj->n", errors, np.linalg.inv(located.covariances[located.valid]), errors
    )
    assert 2.0 < np.mean(squares) < 4.5  # three degrees of freedom
    assert np.quantile(np.abs(errors[:, 2]) / points[located.valid, 2], 0.5) < 0.01


def test_mismatches_are_rejected():
    points, descriptors = _made()
    rng = np.random.default_rng(3)
    wrong = rng.random(len(points)) < 0.3
    order = []
    for _ in POSES:  # these points have other mismatches in each image
        rows = np.arange(len(points))
        rows[wrong] = rng.permutation(rows[wrong])
        order.append(rows)
    located = _located(points, descriptors, order)
    assert located.valid[~wrong].mean() > 0.95
    assert located.valid[wrong].mean() < 0.05


def test_one_picture_suffices_with_the_sigma_that_it_has():
    points, descriptors = _made()
    one, all_of_them = (_located(points, descriptors, poses=poses) for poses in (POSES[:1], POSES))
    assert one.valid.mean() > 0.9
    errors = (one.points_cam - points)[one.valid]
    squares = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(one.covariances[one.valid]), errors)
    assert 2.0 < np.mean(squares) < 4.5  # three degrees of freedom
    both = one.valid & all_of_them.valid
    assert np.median(one.covariances[both, 2, 2] / all_of_them.covariances[both, 2, 2]) > 1.5


def test_no_picture_or_no_motion_locates_nothing():
    points, descriptors = _made(50)
    for poses in ([], [Rigid3.identity()] * 3):
        located = _located(points, descriptors, poses=poses)
        assert not located.valid.any()
        assert np.isnan(located.points_cam).all()


def test_points_of_the_rendered_room():
    panels = tiny_world.room()
    poses = [tiny_world.path_pose(index) for index in range(10)]
    (left, depth), *others = (
        tiny_world.render(panels, pose, noise_seed=k) for k, pose in enumerate(poses)
    )
    features = extract_features(left, FeatureConfig())
    pictures = []
    for k in select_source_images(poses, 0):
        found = extract_features(others[k - 1][0], FeatureConfig())
        pictures.append(
            SourceImage(
                found,
                keypoint_sigmas(found),
                tiny_world.CAMERA,
                poses[k].inverse() @ poses[0],
            )
        )
    located = triangulate_from_motion(
        features,
        keypoint_sigmas(features),
        tiny_world.CAMERA,
        pictures,
    )
    columns, rows = np.rint(features.points_img[located.valid]).astype(int).T
    truth = depth[rows, columns]
    errors = (located.points_cam[located.valid, 2] - truth) / np.sqrt(
        located.covariances[located.valid, 2, 2]
    )
    assert located.valid.mean() > 0.3
    assert (np.abs(errors) > 4).mean() < 0.03


class TestChoice:
    """Test the selection of images that triangulate the points of another."""

    LINE = tuple(Rigid3(np.eye(3), np.array([0.1 * k, 0.0, 0.0])) for k in range(40))

    def test_distances_grow(self):
        chosen = select_source_images(self.LINE, 5)
        assert sorted(abs(k - 5) for k in chosen) == [1, 1, 2, 2, 4, 4, 7, 11, 17, 27]

    def test_the_order_of_images_does_not_matter(self):
        order = np.random.default_rng(1).permutation(40)
        shuffled = [self.LINE[k] for k in order]
        chosen = select_source_images(shuffled, order.tolist().index(5))
        assert {int(order[k]) for k in chosen} == set(select_source_images(self.LINE, 5))

    def test_pictures_that_look_elsewhere_or_stand_in_one_place_do_not_count(self):
        turned = [
            Rigid3(exp_so3(np.array([0.0, 1.5 * (k % 2), 0.0])), pose.translation)
            for k, pose in enumerate(self.LINE)
        ]
        assert all(k % 2 == 0 for k in select_source_images(turned, 4))
        assert select_source_images([Rigid3.identity()] * 5, 0) == []
