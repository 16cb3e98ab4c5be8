"""Test pairs and tracks of photos with known points and poses."""

from __future__ import annotations

import numpy as np
from made_photos import SIGMA_PX, made_photos

import tiny_world
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.open import open_sequence
from topoloc.recordings.recording import as_monocular
from topoloc.slam.image_tracks import (
    ImagePair,
    extract_images,
    join_tracks,
    match_all,
    match_images,
)

IMAGES, POSES = made_photos()


def step(pair: ImagePair, poses: list[Rigid3]) -> Rigid3:
    return poses[pair.second].inverse() @ poses[pair.first]


def test_pairs_match_along_the_epipolar_lines_of_the_poses():
    pairs, shares = match_images(IMAGES, POSES, 4, 10.0)
    errors = np.concatenate([pair.errors_px(IMAGES, step(pair, POSES)) for pair in pairs])
    assert (shares == 1.0).all()
    assert errors.max() < 10.0
    assert 0.3 * SIGMA_PX < np.median(errors) < SIGMA_PX  # Sampson's error of two images
    wider = [pair.errors_px(IMAGES, step(pair, POSES), 1.1) for pair in pairs]
    assert np.median(np.concatenate(wider)) > 1.5 * np.median(errors)


def test_an_image_with_a_wrong_pose_matches_only_without_poses():
    poses = [*POSES]
    poses[7] = Rigid3(poses[7].rotation, poses[7].translation + np.array([0.0, 0.6, 0.0]))
    _, shares = match_images(IMAGES, poses, 4, 10.0)
    assert shares[7] <= 0.5
    assert np.argmin(shares) == 7
    found = match_all(IMAGES, [7])
    assert len(found) >= 4
    assert all(7 in (pair.first, pair.second) for pair in found)
    true_errors = [np.median(pair.errors_px(IMAGES, step(pair, POSES))) for pair in found]
    assert max(true_errors) < 2.0


def test_equal_poses_have_no_pairs():
    pairs, shares = match_images(IMAGES, [POSES[0]] * len(IMAGES), 4, 10.0)
    assert pairs == []
    assert not shares.any()


def test_tracks_join_images_of_one_point_and_leave_out_contradictions():
    features = [np.array([[0, 0], [1, 1]]), np.array([[0, 2], [1, 3]]), np.array([[5, 3], [6, 2]])]
    pairs = [
        ImagePair(first, second, rows)
        for (first, second), rows in zip([(0, 1), (1, 2), (0, 2)], features, strict=True)
    ]
    three = IMAGES[:3]
    assert all((of_image == -1).all() for of_image in join_tracks(three, pairs))  # 0 and 6 are one
    first, second, third = join_tracks(three, pairs[:2])
    assert first[:3].tolist() == second[:3].tolist() == [0, 1, -1]
    assert third[:4].tolist() == [-1, -1, 0, 1]


def test_features_of_frames_are_pixels_of_a_pinhole(tmp_path):
    tiny_world.write_stereo_recording(tmp_path, indices=[0, 1])
    sequence = as_monocular(open_sequence(tmp_path))
    (image,) = extract_images(sequence, [1])
    assert len(image.features) > 100
    assert np.allclose(image.points_img, image.features.points_img, atol=1e-3)
    assert np.allclose(image.rays[:, 2], 1.0)
