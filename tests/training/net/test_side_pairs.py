"""Test the pairs of walls seen from both ends that train `topoloc-net-sides`: rendered routes, and
images on a wall."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from built_corridor import WIDE, WalkAhead, back, corridor
from tiny_world import render, smooth_texture
from topoloc.errors import RecordingError
from topoloc.recordings.frame import MemorySequence, StereoFrame
from topoloc_training.net.side_pairs import find_side_pairs
from topoloc_training.net.slants import slanted


def walk_back(with_pose: bool = True) -> MemorySequence:
    poses = [back(y) for y in (5.0, 6.5)]
    pictures = [
        render(corridor(), pose, WIDE, noise_seed=900 + k)[0] for k, pose in enumerate(poses)
    ]
    frames = [
        StereoFrame(
            f"{k}", 100_000_000 * k, picture, WIDE, world_from_cam=pose if with_pose else None
        )
        for k, (picture, pose) in enumerate(zip(pictures, poses, strict=True))
    ]
    return MemorySequence(frames, "back")


def test_pairs_of_side_views_are_the_same_points_of_a_wall(tmp_path: Path):
    pairs = find_side_pairs(WalkAhead(0, num_pairs=6), walk_back(), tmp_path)
    assert {Path(pair.other).name.split("-")[2] for pair in pairs} == {"left", "right"}
    for pair in pairs:
        assert ("left" in Path(pair.day).name) != ("left" in Path(pair.other).name)
        first, second = (
            cv2.imread(path, cv2.IMREAD_GRAYSCALE).astype(float) for path in (pair.day, pair.other)
        )
        x, y = np.round(pair.day_px).astype(int).T
        u, v = np.round(pair.other_px).astype(int).T
        apart = np.abs(first[y, x] - second[v, u])
        shuffled = np.abs(first[y, x] - np.roll(second[v, u], len(u) // 2))
        assert np.median(apart) < 0.4 * np.median(shuffled)


def test_pairs_need_the_poses(tmp_path: Path):
    with pytest.raises(RecordingError, match="pose"):
        find_side_pairs(WalkAhead(0, num_pairs=2), walk_back(with_pose=False), tmp_path)


def test_a_slanted_wall_keeps_its_points_and_loses_distant_ones():
    texture = cv2.resize(smooth_texture(3, (1.0, 0.8)), (320, 256)).astype(np.float32) / 255
    fine = (texture + 0.3 * (np.indices(texture.shape)[1] % 14 < 7)).astype(
        np.float32
    )  # stripes that a slant smears
    for is_ahead_right in (True, False):
        shown = slanted(fine, is_ahead_right, np.random.default_rng(1))
        assert shown.shape == fine.shape
        smooth, expected = (cv2.GaussianBlur(picture, (0, 0), 6.0) for picture in (shown, fine))
        assert np.abs(smooth - expected)[20:-20, 20:-20].mean() < 0.05
        stripes = np.abs(np.diff(shown, axis=1)).mean(axis=0)
        left, right = stripes[20:80].mean(), stripes[-80:-20].mean()
        assert (left > 1.2 * right) == is_ahead_right
        assert (right > 1.2 * left) != is_ahead_right
