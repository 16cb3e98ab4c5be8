"""Test bundle adjustment of synthetic key frames with known truth."""

from __future__ import annotations

import numpy as np
import pytest

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.points.metric_points import StereoCamera
from topoloc.slam.bundle.bundle_adjustment import PosePrior, adjust_bundle
from topoloc.slam.keyframes import DisparityBias, KeyFrame, KeyFrameObservations, Landmarks

STEREO = StereoCamera(Camera.pinhole(640, 400, 380.0, 380.0, 319.5, 199.5), 45.0)
NOISE_PX = 0.2


def world(
    num: int = 5, bias_px: float = 0.0
) -> tuple[list[KeyFrame], Landmarks, list[Rigid3], np.ndarray]:
    """Return key frames that move past a cloud of points, visible in all of them. Poses and points
    have initial errors."""
    rng = np.random.default_rng(4)
    points = np.column_stack(
        [rng.uniform(-3, 4, 150), rng.uniform(-1.5, 1.5, 150), rng.uniform(3, 12, 150)]
    )
    landmarks = Landmarks()
    ids = landmarks.add(points + rng.normal(0, 0.1, points.shape))
    bias = DisparityBias(0.0, 1.0) if bias_px else DisparityBias()
    keyframes, poses = [], []
    for k in range(num):
        pose = Rigid3.exp(np.array([-0.3 * k, 0.02 * k, -0.2 * k, 0.01 * k, 0.03 * k, 0.0]))
        measured = (
            STEREO.project(pose.apply(points))
            + rng.normal(0, NOISE_PX, (len(points), 3))
            + [0.0, 0.0, bias_px]
        )
        seen = KeyFrameObservations(
            ids, measured, np.full((len(points), 3), 1.0 / NOISE_PX), np.ones(len(points), np.bool_)
        )
        wrong = Rigid3.exp(rng.normal(0, 0.02, 6)) @ pose if k else pose
        keyframes.append(KeyFrame(0, k, 100_000_000 * k, 0, STEREO, wrong, seen, bias))
        poses.append(pose)
    return keyframes, landmarks, poses, points


def pose_errors(keyframes: list[KeyFrame], poses: list[Rigid3]) -> np.ndarray:
    return np.array(
        [
            np.linalg.norm((k.cam_from_world @ pose.inverse()).log())
            for k, pose in zip(keyframes, poses, strict=True)
        ]
    )


def test_wrong_poses_and_points_are_put_right_and_the_first_stays():
    keyframes, landmarks, poses, points = world()
    before = pose_errors(keyframes, poses)
    adjust_bundle(keyframes, [], landmarks)
    after = pose_errors(keyframes, poses)
    assert after[0] == 0.0
    assert after.max() < 0.005 < before[1:].min()
    assert np.median(np.linalg.norm(landmarks.positions[: len(points)] - points, axis=1)) < 0.05


def test_fixed_keyframes_do_not_move():
    keyframes, landmarks, poses, _ = world()
    keyframes[0].cam_from_world, keyframes[1].cam_from_world = poses[0], poses[1]
    held = [keyframe.cam_from_world for keyframe in keyframes[:2]]
    adjust_bundle(keyframes[2:], keyframes[:2], landmarks)
    assert [keyframe.cam_from_world for keyframe in keyframes[:2]] == held
    assert pose_errors(keyframes, poses).max() < 0.005


@pytest.mark.parametrize("bias_px", [-1.5, 0.8])
def test_a_bias_of_all_disparities_is_found_with_the_motion(bias_px: float):
    keyframes, landmarks, poses, _ = world(8, bias_px)
    adjust_bundle(keyframes, [], landmarks, max_steps=20)
    assert keyframes[0].bias.value_px == pytest.approx(bias_px, abs=0.25)
    assert pose_errors(keyframes, poses).max() < 0.1


def test_wrong_observations_are_outvoted_and_marked():
    keyframes, landmarks, poses, _ = world()
    seen = keyframes[3].observations
    seen.measured[:20, 0] += 30.0
    adjust_bundle(keyframes, [], landmarks, max_steps=15)
    assert not seen.active[:20].any()
    assert seen.active[20:].mean() > 0.95
    assert pose_errors(keyframes, poses).max() < 0.01


def test_unknown_disparities_do_no_harm():
    keyframes, landmarks, poses, _ = world()
    for keyframe in keyframes[1:]:
        keyframe.observations.measured[::2, 2] = np.nan
        keyframe.observations.weights[::2, 2] = 0.0
    adjust_bundle(keyframes, [], landmarks)
    assert pose_errors(keyframes, poses).max() < 0.01


def walk_around(num: int, num_new: int) -> tuple[list[KeyFrame], Landmarks, list[Rigid3]]:
    """Walk twice around a ring. Each key frame observes its own points and the points of two frames
    before it. The poses drift at first."""
    rng = np.random.default_rng(7)
    step = Rigid3.exp(np.array([0.0, 0.0, -0.3, 0.0, 4.0 * np.pi / num, 0.0]))
    poses = [Rigid3.exp(np.zeros(6))]
    while len(poses) < num:
        poses.append(step @ poses[-1])
    lap = num // 2
    ahead = np.stack(
        [
            rng.uniform(-2, 2, (lap, num_new)),
            rng.uniform(-1, 1, (lap, num_new)),
            rng.uniform(3, 6, (lap, num_new)),
        ],
        -1,
    )
    points = np.array(
        [pose.inverse().apply(group) for pose, group in zip(poses[:lap], ahead, strict=True)]
    )
    landmarks, keyframes, drift = Landmarks(), [], Rigid3.identity()
    ids = landmarks.add((points + rng.normal(0, 0.02, points.shape)).reshape(-1, 3)).reshape(
        lap, num_new
    )
    for k, pose in enumerate(poses):
        groups = [(k - back) % lap for back in range(3) if k >= back]
        measured = STEREO.project(pose.apply(points[groups].reshape(-1, 3))) + rng.normal(
            0, NOISE_PX, (len(groups) * num_new, 3)
        )
        seen = KeyFrameObservations(
            ids[groups].ravel(),
            measured,
            np.full(measured.shape, 1.0 / NOISE_PX),
            np.ones(len(measured), np.bool_),
        )
        drift = Rigid3.exp(rng.normal(0, 0.002, 6)) @ drift if k else drift
        keyframes.append(
            KeyFrame(0, k, 100_000_000 * k, 0, STEREO, drift @ pose, seen, DisparityBias(0.0, 1.0))
        )
    return keyframes, landmarks, poses


def test_part_by_part_is_the_same_as_all_at_once():
    whole, parts = (walk_around(24, 20) for _ in range(2))
    for keyframe in (*whole[0], *parts[0]):
        keyframe.observations.measured[0, 0] += 40.0
    adjust_bundle(whole[0], [], whole[1])
    adjust_bundle(parts[0], [], parts[1], chunk_size=37)
    for a, b in zip(whole[0], parts[0], strict=True):
        np.testing.assert_allclose(a.cam_from_world.matrix(), b.cam_from_world.matrix(), atol=1e-9)
        np.testing.assert_array_equal(a.observations.active, b.observations.active)
        assert not a.observations.active[0]
    np.testing.assert_allclose(
        whole[1].positions[: whole[1].num], parts[1].positions[: parts[1].num], atol=1e-7
    )


@pytest.mark.slow
def test_a_walk_of_many_key_frames_is_adjusted_whole():
    """The number of key frames exceeds the former limit of a dense matrix."""
    keyframes, landmarks, poses = walk_around(700, 8)
    before = pose_errors(keyframes, poses)
    adjust_bundle(keyframes, [], landmarks, max_steps=12, chunk_size=5000)
    assert before.max() > 0.05
    assert pose_errors(keyframes, poses).max() < 0.5 * before.max()


def test_anchors_fix_all_poses_and_a_wrong_one_bends_nothing():
    keyframes, landmarks, poses, _ = world(8)
    shift = Rigid3.exp(np.array([0.3, -0.2, 0.1, 0.05, 0.02, -0.04]))
    there = [pose @ shift for pose in poses]
    told = [PosePrior(keyframes[k], there[k], 1e6 * np.eye(6)) for k in (0, 2, 4, 5, 7)]
    told.append(PosePrior(keyframes[6], Rigid3.exp(np.full(6, 0.4)) @ there[6], 1e6 * np.eye(6)))
    adjust_bundle(keyframes, [], landmarks, told, max_steps=60, min_decrease=1e-9)
    assert pose_errors(keyframes, there).max() < 0.005


def test_observations_and_landmarks_take_little_memory():
    keyframes, landmarks, _, points = world(2)
    seen = keyframes[0].observations
    seen.append(
        KeyFrameObservations(np.array([7]), np.ones((1, 3)), np.ones((1, 3)), np.ones(1, np.bool_))
    )
    arrays = [seen.landmark_ids, seen.measured, seen.weights, seen.active]
    assert sum(array.nbytes for array in arrays) <= 29 * len(seen.active)
    for _ in range(200):
        landmarks.add(points)
    assert len(landmarks.positions) <= 1.25 * landmarks.num + len(points)
    np.testing.assert_array_equal(
        landmarks.positions[landmarks.num - len(points) : landmarks.num], points
    )
