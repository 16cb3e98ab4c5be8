"""Test that given poses of photos are measurements: approximate ones come nearer to the truth, a
wrong one is named, a wrong focal length is said, and right poses stay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_photos import CAMERA, made_photos, with_noise

import tiny_world
from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import MemorySequence, StereoSequence
from topoloc.recordings.open import open_sequence
from topoloc.recordings.recording import as_monocular, with_poses
from topoloc.slam.image_tracks import match_images
from topoloc.slam.pose_adjustment import adjust_poses, correct_poses, find_focal_factor

IMAGES, POSES = made_photos()


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> StereoSequence:
    folder = tmp_path_factory.mktemp("photos")
    tiny_world.write_stereo_recording(folder, indices=[float(k) for k in range(12)])
    return as_monocular(open_sequence(folder))


def posed(sequence: StereoSequence) -> list[Rigid3]:
    return [pose for pose in sequence.poses if pose is not None]


def median_errors(poses: list[Rigid3]) -> np.ndarray:
    pairs = list(zip(poses, POSES, strict=True))
    return np.median([(translation_error(*k), rotation_error(*k)) for k in pairs], axis=0)


def test_approximate_poses_come_nearer_to_the_truth_in_their_world():
    given = with_noise(POSES, 0.005, 0.5)
    found = adjust_poses(IMAGES, given, 3.0)
    assert found is not None
    before, after = median_errors(given), median_errors(found)
    assert after[1] < 0.6 * before[1]
    assert after[0] < 1.1 * before[0]


def test_right_poses_are_not_adjusted():
    assert adjust_poses(IMAGES, POSES, 0.5) is None


@pytest.mark.parametrize("factor", [0.95, 1.05])
def test_a_wrong_focal_length_is_found(factor: float):
    camera = Camera.pinhole(640, 480, factor * CAMERA.fx, factor * CAMERA.fy, CAMERA.cx, CAMERA.cy)
    images = [replace(image, camera=camera) for image in IMAGES]
    pairs, _ = match_images(images, POSES, 4, 20.0)
    assert find_focal_factor(images, pairs, POSES) == pytest.approx(1.0 / factor, abs=0.01)
    pairs, _ = match_images(IMAGES, POSES, 4, 20.0)
    assert find_focal_factor(IMAGES, pairs, POSES) is None


def test_right_poses_of_images_stay(photos: StereoSequence):
    said = list[str]()
    found = correct_poses(photos, said.append)
    assert said == []
    assert all(a is b for a, b in zip(found.poses, photos.poses, strict=True))


def test_a_wrong_pose_is_named_and_left_out(photos: StereoSequence):
    poses, said = posed(photos), list[str]()
    poses[5] = Rigid3(poses[5].rotation, poses[5].translation + np.array([0.0, 0.0, 0.3]))
    found = correct_poses(with_poses(photos, [*poses]), said.append)
    assert [k for k, pose in enumerate(found.poses) if pose is None] == [5]
    assert len(said) == 1
    assert f"the pose of {photos.names[5]} is wrong" in said[0]


def test_approximate_poses_of_images_are_corrected_and_said(photos: StereoSequence):
    poses, said = with_noise(posed(photos), 0.005, 0.7), list[str]()
    found = posed(correct_poses(with_poses(photos, [*poses]), said.append))
    assert len(said) == 1
    assert "poses corrected by" in said[0]
    turns = [
        np.median([rotation_error(*k) for k in zip(one, posed(photos), strict=True)])
        for one in (poses, found)
    ]
    assert turns[1] < 0.8 * turns[0]


def test_photos_that_share_too_little_are_counted_and_named(photos: StereoSequence):
    said, last = list[str](), photos[-1]
    away = Rigid3(np.diag([-1.0, 1.0, -1.0]), np.array([0.0, 0.0, -40.0]))
    blank = [
        replace(
            last,
            name=f"blank{k}.png",
            t_ns=last.t_ns + k,
            image=np.full_like(last.image, 128),
            world_from_cam=Rigid3(away.rotation, away.translation + k),
        )
        for k in (1, 2)
    ]
    frames = [photos[k] for k in range(len(photos))]
    frames = [replace(frame, right=None, rig=None) for frame in (*frames, *blank)]
    found = correct_poses(MemorySequence(frames, "walk"), said.append)
    assert said == [
        "walk: 2 of 14 pictures share too little with the others, so their poses are not checked:"
        " blank1.png, blank2.png; take more between them and the others"
    ]
    assert all(pose is not None for pose in found.poses)


def test_few_photos_and_equal_poses_are_left_as_they_are(photos: StereoSequence):
    equal = with_poses(photos, [posed(photos)[0]] * len(photos))
    said = list[str]()
    for sequence in (photos[:3], equal):
        assert correct_poses(sequence, said.append).poses == sequence.poses
    assert said == []
